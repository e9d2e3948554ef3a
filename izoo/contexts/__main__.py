"""Entry point of ``python -m izoo.contexts``."""

import sys

from izoo.contexts.commands import main

if __name__ == "__main__":
    sys.exit(main())
