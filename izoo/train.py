"""``python -m izoo.train``: train a policy on eco-driving contexts and compare it with human driving."""

import sys

from izoo.cli.entries import TRAIN as COMMAND

main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
