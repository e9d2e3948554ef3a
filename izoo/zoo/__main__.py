"""``python -m izoo.zoo``: the trained policies that ship, and how to put one on the shelf."""

import sys

from izoo.cli.zoo import ZOO

main = ZOO.main

if __name__ == "__main__":
    sys.exit(main())
