"""The program: ``splatsoil``, or ``python -m splatsoil``."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line. Ctrl-C while that is still being loaded ends without a traceback, too."""
    try:
        from splatsoil.cli import main as run

        return run()
    except KeyboardInterrupt:
        print("\nsplatsoil: interrupted; start the command again", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
