"""`python -m pi_controller` is `polysight-pi`."""

import sys

from pi_controller.cli import main

sys.exit(main())
