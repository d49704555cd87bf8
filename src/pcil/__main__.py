"""`python -m pcil` is `pcil`."""

import sys

if sys.argv[0] == __file__ and not sys.flags.safe_path:
    del sys.path[0]  # the present folder, where Python would look for every library first

from pcil.cli import main

sys.exit(main())
