"""Human drivers calibrated on recorded trajectories (``izoo/docs/calibration.md``).

:mod:`~izoo.drivers.recorded_pairs` reads files, :mod:`~izoo.drivers.checks` refuses what cannot be right, and
:mod:`~izoo.drivers.trajectories` makes drivers of them; all else needs the extra ``izoo[calibrate]``.
"""
