"""``python -m bbfit.cli``."""

import sys

from bbfit.cli import main

if __name__ == "__main__":  # and not in the processes that a sweep starts
    sys.exit(main())
