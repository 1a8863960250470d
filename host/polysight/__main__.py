"""`python -m polysight` is `polysight`."""

import sys

from polysight.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
