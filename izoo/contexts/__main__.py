"""``python -m izoo.contexts``: see :mod:`izoo.cli.contexts`."""

import sys

from izoo.cli.contexts import CONTEXTS

main = CONTEXTS.main

if __name__ == "__main__":
    sys.exit(main())
