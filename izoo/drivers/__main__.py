"""Entry point of ``python -m izoo.drivers``."""

import sys

from izoo.commands.calibrate import main

if __name__ == "__main__":
    sys.exit(main())
