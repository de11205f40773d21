"""``python -m splatsoil``."""

import sys

from splatsoil.cli import main

if __name__ == "__main__":
    sys.exit(main())
