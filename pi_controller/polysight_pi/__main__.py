"""`python -m polysight_pi` is `polysight-pi`."""

import sys

from polysight_pi.cli import main

sys.exit(main())
