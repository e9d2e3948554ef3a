"""``python -m izoo.report``: results as one HTML page that opens from disk; the runs of a sweep as a table."""

import sys

from izoo.cli.option_command import OptionCommand

COMMAND = OptionCommand(
    name="report",
    summary="Write results as one HTML page that opens from disk; of a sweep, show its runs side by side.",
    examples=(
        "izoo.report results/busy_lane out=report.html",
        "izoo.report results/campaign task=busy_lane",
        "izoo.report runs/DATE-sweep",
    ),
    config="izoo.conf.report_options:ReportConfig",
    work="izoo.cli.report:report",
    place="results",
)
main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
