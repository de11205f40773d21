"""The program: ``splatsoil``, or ``python -m splatsoil``."""

from __future__ import annotations

import os
import sys


def main() -> int:
    """Run the command line. Ctrl-C while that is still being loaded ends without a traceback, too, and so does a reader
    of the output (head, less) that has gone, of a help page as well."""
    try:
        from splatsoil.cli import main as run

        try:
            return run()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print("\nsplatsoil: interrupted; start the command again", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
