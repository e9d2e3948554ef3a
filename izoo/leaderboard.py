"""``python -m izoo.leaderboard``: check leaderboard files and merge them into one."""

import sys

from izoo.cli.leaderboard import LEADERBOARD

main = LEADERBOARD.main

if __name__ == "__main__":
    sys.exit(main())
