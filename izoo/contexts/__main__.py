"""``python -m izoo.contexts``: see :mod:`izoo.commands.contexts`."""

import sys

from izoo.commands.contexts import CONTEXTS

main = CONTEXTS.main

if __name__ == "__main__":
    sys.exit(main())
