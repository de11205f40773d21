"""What there is to compute with."""

from __future__ import annotations

from splatsoil.errors import ParameterError


def resolve_device(name: str) -> str:
    """A device that is here: ``auto`` becomes the first CUDA device, or the CPU where there is none.

    Raises:
        ParameterError: there is no such device.
    """
    import torch

    if name == "auto":
        return "cuda:0" if torch.cuda.is_available() else "cpu"
    known = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if name not in known:
        raise ParameterError(f"there is no device {name!r} here; choose one of auto, {', '.join(known)}")
    return name
