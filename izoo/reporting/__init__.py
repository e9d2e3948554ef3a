"""Results as one HTML page that needs nothing else, and as leaderboard files.

- :mod:`~izoo.reporting.material`: what a results folder holds.
- :mod:`~izoo.reporting.scored`, :mod:`~izoo.reporting.rows`: the numbers, per policy and per approach.
- :mod:`~izoo.reporting.figures`: figures for plotly.js, with :mod:`~izoo.reporting.histograms` and
  :mod:`~izoo.reporting.curves`; :mod:`~izoo.reporting.drawing` is what they share.
- :mod:`~izoo.reporting.replay`, :mod:`~izoo.reporting.recording`: episodes to be watched.
- :mod:`~izoo.reporting.page`, ``templates``: the page.
- :mod:`~izoo.reporting.published`: the paper's figures, to stand beside ours.
- :mod:`~izoo.reporting.results`, :mod:`~izoo.reporting.submissions`: the benchmark's index and submissions.
"""
