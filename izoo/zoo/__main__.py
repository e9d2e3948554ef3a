"""``python -m izoo.zoo``: the trained policies that ship, and how to export your own."""

import sys

from izoo.cli.zoo import ZOO

main = ZOO.main

if __name__ == "__main__":
    sys.exit(main())
