"""Keeping a command's output its own."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile

from splatsoil.errors import RunError

_KERNELS = 2**20  # bytes, about what one of Warp's compiled modules takes


def hush() -> None:
    """Silence Warp's messages on kernels it loads and GPUs it lacks.

    Where its folder for compiled kernels can't be written to, they go into one that ends with the process.

    Raises:
        RunError: no folder can be written to, or Warp lacks its compiler for CPUs.
    """
    import warp

    warp.config.log_level = warp.LOG_ERROR
    # The message that there is no GPU is written below Python, at any level.
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        try:
            warp.init()
            with tempfile.TemporaryFile(dir=warp.config.kernel_cache_dir) as file:
                file.write(bytes(_KERNELS))
                file.flush()
            fault = None
        except OSError as error:
            fault = error
            warp.config.kernel_cache_dir = os.environ["WARP_CACHE_PATH"] = _temporary_folder()  # helpers' as well
            warp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
    if not warp.is_cpu_available():
        raise RunError(
            "warp: its compiler for CPUs (warp-clang) cannot be loaded, and work on a GPU needs it, too, for the "
            "tool's mesh and what is drawn of it; install warp-lang anew, from a wheel of this machine's architecture"
        )
    if fault is not None:
        print(
            f"splatsoil: kernels are compiled anew each time: {fault.filename or 'their folder'} cannot be written"
            f" ({fault.strerror}); let WARP_CACHE_PATH name a folder that can",
            file=sys.stderr,
        )


def _temporary_folder() -> str:
    try:
        folder = tempfile.mkdtemp(prefix="splatsoil-kernels-")
    except OSError as error:
        raise RunError(f"kernels: no folder can be written to ({error.strerror}); set WARP_CACHE_PATH") from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
