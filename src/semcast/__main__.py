"""Run the command line as ``python -m semcast``."""

import sys

from semcast.cli import main

sys.exit(main())
