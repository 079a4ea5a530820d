"""`python -m compensator` is the command `compensator`."""

import sys

from compensator.cli import main

sys.exit(main())
