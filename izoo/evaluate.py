"""``python -m izoo.evaluate``: compare a policy with human driving, episode by episode."""

import sys

from izoo.cli.entries import EVALUATE as COMMAND

main = COMMAND.main

if __name__ == "__main__":
    sys.exit(main())
