"""Room: reporting. An evaluation's folder as one HTML page that needs nothing else.

- :mod:`~izoo.reporting.figures`: histograms and scatter plots as SVG.
- :mod:`~izoo.reporting.page`: the page.
- :mod:`~izoo.reporting.published`: the paper's figures, to stand beside ours.
"""
