"""What is shown of results: tables, charts, a page, replays, leaderboard files.

- :mod:`~izoo.report.tables`: a summary as tables for the console, Markdown and HTML.
- :mod:`~izoo.report.report_data`: what a folder of results holds; :mod:`~izoo.report.sweeps`: what a sweep does.
- :mod:`~izoo.report.plots`: charts; :mod:`~izoo.report.replay`, :mod:`~izoo.report.recording`: episodes to be watched.
- :mod:`~izoo.report.page`, ``templates``: the page; :mod:`~izoo.report.paper_results`: the paper's figures.
- :mod:`~izoo.report.leaderboard`: leaderboard files; :mod:`~izoo.report.movements`: delay and queues by movement.
"""
