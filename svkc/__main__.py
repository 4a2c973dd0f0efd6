"""`python -m svkc`."""

import sys

from svkc.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
