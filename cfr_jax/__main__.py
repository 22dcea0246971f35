"""`python -m cfr_jax` is the command `cfr`."""

import sys

from cfr_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
