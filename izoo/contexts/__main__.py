"""Entry point of ``python -m izoo.contexts``, whose commands come from several rooms."""

import sys

from izoo.commands.contexts import main

if __name__ == "__main__":
    sys.exit(main())
