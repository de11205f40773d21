"""The program's first moments: Ctrl-C while the package is being loaded, which takes a second.

It imports next to nothing: until it is there, Ctrl-C ends in Python's own traceback.
"""

from __future__ import annotations

import os
import signal
import sys

SAID = "splatsoil: interrupted; start the command again"


def heed_interrupts() -> None:
    """Where this process is the program, have Ctrl-C end it in one line; nothing is at stake yet.

    Who imports the package keeps the handler that is there, and a shell's background job goes on ignoring the signal.
    """
    started = sys.argv[:1] == ["-m"] and "splatsoil" in sys.orig_argv
    named = os.path.basename(sys.argv[0] if sys.argv else "") in ("splatsoil", "splatsoil.exe")  # noqa: PTH119
    if (started or named) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)


def end(number: int, frame: object) -> None:
    """End here: an exception could be caught, and forgotten, by a module that is being loaded."""
    os.write(2, f"\n{SAID}\n".encode())
    os._exit(130)
