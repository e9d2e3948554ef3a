"""Entry point of ``python -m izoo.contexts``, whose commands come from several rooms."""

import sys

from izoo.context_tools.commands import main

if __name__ == "__main__":
    sys.exit(main())
