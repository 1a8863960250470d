"""`python -m polysight.host` is `polysight`."""

import sys

from polysight.host.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
