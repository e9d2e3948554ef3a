"""``python -m izoo.report``: results as one HTML page that opens from disk; the runs of a sweep as a table."""

import sys

from izoo.cli.entries import REPORT as COMMAND

main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
