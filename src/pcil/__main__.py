"""`python -m pcil` is `pcil`."""

import sys

from pcil.cli import main

sys.exit(main())
