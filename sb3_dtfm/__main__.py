"""`python -m sb3_dtfm` is `sb3-dtfm`."""

import sys

from sb3_dtfm.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
