"""The program: ``splatsoil``, or ``python -m splatsoil``."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from types import FrameType

from splatsoil.starting import MESSAGE, end

_AGAIN = 0.05  # seconds until an interrupt that came while a module was being loaded is tried again


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, but only once no module is being loaded: some catch it meanwhile, and go on."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            again = threading.Timer(_AGAIN, os.kill, (os.getpid(), number))
            again.daemon = True
            again.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def main() -> int:
    """Run the command line. Ctrl-C while that is still being loaded ends without a traceback, too, and so does a reader
    of the output (head, less) that has gone, of a help page as well."""
    if signal.getsignal(signal.SIGINT) in (signal.default_int_handler, end):
        signal.signal(signal.SIGINT, _interrupt)
    try:
        from splatsoil.cli import main as run

        try:
            code = run()
        finally:
            sys.stdout.flush()
        if code == 130:
            # At its end Python would wait for threads, of those that serve a browser as long as it is open.
            atexit._run_exitfuncs()
            sys.stderr.flush()
            os._exit(code)
        return code
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print(f"\n{MESSAGE}", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
