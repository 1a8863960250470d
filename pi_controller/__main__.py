"""`python -m polysight.pi_controller` is `polysight-pi`."""

import sys

from polysight.pi_controller.cli import main

sys.exit(main())
