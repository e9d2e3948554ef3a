"""Human drivers from data: the Bayesian calibration of IDM (``python -m izoo.drivers calibrate``).

``tables`` reads files and ``checks`` refuses what cannot be right; ``followers`` makes drivers of them. ``update`` is
one step of IDM, ``pilot`` a first fit, ``hierarchy`` the model, ``chains`` the sampler; ``predictive`` asks whether the
model drives as the drivers did. ``estimate`` joins them, and ``posterior_figure`` draws the result. All but the first
three need the extra ``izoo[calibrate]``.
"""
