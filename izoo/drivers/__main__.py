"""Entry point of ``python -m izoo.drivers``."""

import sys

from izoo.cli.calibrate import main

if __name__ == "__main__":
    sys.exit(main())
