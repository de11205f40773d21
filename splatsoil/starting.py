"""Ctrl-C while the package is loading, which takes a second; until this module is loaded, it ends in a traceback."""

from __future__ import annotations

import os
import signal
import sys

MESSAGE = "splatsoil: interrupted; start the command again"


def heed_interrupts() -> None:
    """In the program itself, end on Ctrl-C with one line.

    Other programs that import the package keep their handler; a background job keeps ignoring the signal.
    """
    started = sys.argv[:1] == ["-m"] and "splatsoil" in sys.orig_argv
    named = os.path.basename(sys.argv[0] if sys.argv else "") in ("splatsoil", "splatsoil.exe")  # noqa: PTH119
    if (started or named) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)


def end(number: int, frame: object) -> None:
    """Exit; a module that is loading could catch an exception."""
    os.write(2, f"\n{MESSAGE}\n".encode())
    os._exit(130)
