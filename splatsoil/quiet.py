"""Keeping a command's output its own."""

from __future__ import annotations

import os
import sys


def hush() -> None:
    """Keep Warp from telling which kernels it loads, and that it found no GPU."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    # That there is no GPU it tells below Python, whatever the level.
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        warp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
