"""Files that are whole or absent: every result is written beside its place and then moved onto it."""

from __future__ import annotations

import errno
import hashlib
import io
import json
import math
import os
import re
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NoReturn
from zipfile import BadZipFile, ZipFile

import numpy as np

from splatsoil.errors import ParameterError, RunError

#: Most bytes that an archive of a set or a run folder unpacks to: twenty times those of the finest preset.
MOST_UNPACKED = 2**30
_HIDDEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
#: Remedy for a damaged file that a command makes anew.
ANEW = "delete it and run the command again"


def write_bytes(path: str | Path, data: bytes) -> Path:
    """Write ``data`` to ``path`` so that a reader, or a crash, never sees half of it.

    Raises:
        RunError: the folder can't be written to.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent)
    except OSError as error:
        raise _unwritable(target, error) from error
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes private files; a result is for everybody whom the user's umask lets read it.
        umask = os.umask(0)
        os.umask(umask)
        Path(name).chmod(0o666 & ~umask)
        Path(name).replace(target)
    except BaseException as error:
        Path(name).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _unwritable(target, error) from error
        raise
    return target


def _unwritable(path: str | Path, error: OSError) -> RunError:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    advice = "free some space and try again" if full else "choose a folder you may write to"
    return RunError(f"{path}: cannot be written ({error.strerror}); {advice}")


def check_paths(values: Iterable[Any]) -> None:
    """See that paths among values, and tuples of them, can be those of files.

    Raises:
        ParameterError: one has a null character, or a name that is too long.
    """
    for value in values:
        if isinstance(value, tuple):
            check_paths(value)
        elif isinstance(value, Path):
            try:
                value.lstat()
            except (OSError, ValueError) as error:
                if not isinstance(error, OSError) or error.errno == errno.ENAMETOOLONG:
                    fault = error.strerror if isinstance(error, OSError) else error
                    raise ParameterError(f"{str(value)[:80]!r} is no usable path ({fault})") from error


def check_folder(path: str | Path) -> None:
    """See that results can go into a folder, which need not exist yet, before hours are spent on them; writes nothing.

    Raises:
        RunError: a file is in the way, the folder is a measurement set, or it can't be written to.
    """
    folder = Path(path).absolute()
    check_paths([folder])
    if (folder / "experiment.json").exists():
        raise RunError(f"{path}: is a measurement set, which is not written to; choose another folder for the result")
    there = next(place for place in (folder, *folder.parents) if place.exists())
    if not there.is_dir():
        raise RunError(f"{path}: {there} is a file and no folder; choose another folder for the result")
    # By trying: permissions do not apply to root, nor to read-only file systems.
    try:
        with tempfile.TemporaryDirectory(dir=there):
            pass
    except OSError as error:
        raise _unwritable(path, error) from None


def write_text(path: str | Path, text: str) -> Path:
    """Write ``text`` as UTF-8, whole or not at all."""
    return write_bytes(path, text.encode())


def write_json(path: str | Path, data: Any) -> Path:
    """Write ``data`` as indented, strictly valid JSON; NumPy numbers and arrays are taken, NaN becomes null."""
    return write_text(path, json.dumps(plain(data), indent=1, allow_nan=False) + "\n")


def write_npz(path: str | Path, **arrays: Any) -> Path:
    """Write arrays (numbers are arrays to NumPy) as one of its archives, whole or not at all."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return write_bytes(path, stream.getvalue())


class _Kept(dict[str, Any]):
    """An object of a JSON file, which names the file where it lacks a key."""

    def __init__(self, data: Mapping[str, Any], file: Path, remedy: str) -> None:
        super().__init__(data)
        self.fault = f"{file}: is damaged, it lacks", remedy

    def __missing__(self, key: str) -> NoReturn:
        raise RunError(f"{self.fault[0]} {key}; {self.fault[1]}")


def read_json(path: str | Path, *, remedy: str = ANEW) -> Any:
    """Read a JSON file of a run folder; the remedy is for where that can't be done, or a key is asked for that one of
    its objects lacks.

    Raises:
        RunError: the file is missing, unreadable or not JSON.
    """
    source = Path(path)
    try:
        text = source.read_text(encoding="utf-8")
        data = json.loads(text, object_hook=lambda found: _Kept(found, source, remedy))
    except FileNotFoundError as error:
        raise RunError(f"{source}: there is no such file") from error
    except OSError as error:
        raise RunError(f"{source}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise RunError(f"{source}: is not JSON ({error}); {remedy}") from error
    except RecursionError as error:
        raise RunError(f"{source}: is not JSON of ours (it is nested without end); {remedy}") from error
    if _hides(data):
        raise RunError(f"{source}: holds control characters, which could act on a terminal; {remedy}")
    return data


def _hides(data: Any) -> bool:
    """Whether any text in it has a character that isn't shown, but for ends of lines and tabs."""
    if isinstance(data, dict):
        return any(_hides(key) or _hides(value) for key, value in data.items())
    if isinstance(data, list):
        return any(map(_hides, data))
    return isinstance(data, str) and _HIDDEN.search(data) is not None


def read_npy(path: str | Path) -> np.ndarray:
    """Read a NumPy array of a run folder.

    Raises:
        RunError: it can't be read.
    """
    with _readable(path):
        array = np.load(path, allow_pickle=False)
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
            raise ValueError("is no single array of numbers")
        return array


def read_npz(path: str | Path, names: Iterable[str], *, remedy: str = ANEW) -> dict[str, np.ndarray]:
    """Read arrays of a run folder that `write_npz` wrote, by their names; the remedy is for where that can't be done.

    Raises:
        RunError: it can't be read, or lacks one.
    """
    with _readable(path, remedy):
        check_unpacked(path)
        with np.load(path, allow_pickle=False) as kept:
            return {name: kept[name] for name in names}


def check_unpacked(archive: str | Path | IO[bytes]) -> None:
    """See that a ZIP archive doesn't unpack to more than `MOST_UNPACKED`, as one made to fill a machine does.

    Raises:
        ValueError: it does.
        OSError, BadZipFile: it is none.
    """
    with ZipFile(archive) as opened:
        size = sum(entry.file_size for entry in opened.infolist())
    if size > MOST_UNPACKED:
        raise ValueError(
            f"it would unpack to {size / 2**30:.3g} GiB, more than the {MOST_UNPACKED / 2**30:g} GiB allowed"
        )


@contextmanager
def _readable(path: str | Path, remedy: str = ANEW) -> Iterator[None]:
    """Say in one sentence what NumPy thinks of a file that was cut short, or is no array."""
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, EOFError, MemoryError, BadZipFile, zlib.error) as error:
        raise RunError(f"{path}: cannot be read ({error}); {remedy}") from error


def digest(description: Mapping[str, Any]) -> str:
    """SHA-256 (hex) of a description: equal descriptions, equal digests, whatever the order of their keys."""
    text = json.dumps(plain(dict(description)), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def plain(data: Any) -> Any:
    """``data`` in JSON's own types; non-finite numbers become None."""
    if isinstance(data, dict):
        return {str(key): plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [plain(value) for value in data]
    if isinstance(data, np.ndarray):
        return plain(data.tolist())
    if isinstance(data, np.generic):
        return plain(data.item())
    if isinstance(data, Path):
        return str(data)
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


#: Parts of the package that decide what a reconstruction is, and what an evaluation comes to.
RECONSTRUCTING = ("measurement", "splats", "mpm/presets.py", "reconstruction", "colour.py")
FORWARD = (
    *RECONSTRUCTING,
    *("soil", "mpm", "scene", "parameters.py", "model.py", "observation.py"),
    *("comparison.py", "robust_loss.py", "envs/measured.py"),
    *("experiment/base.py", "experiment/features.py", "experiment/forces.py", "experiment/heights.py"),
    *("experiment/plow.py", "experiment/scene_parts.py"),
)
#: Parts that draw verdicts from features.
CRITICISM = ("inverse/criticism",)


def code_digest(parts: Iterable[str] = FORWARD, others: Iterable[str | Path] = ()) -> str:
    """SHA-256 (16 hex digits) of the package's sources: what they made before they changed isn't what they make now.

    Args:
        parts: folders and files of the package, by their place in it.
        others: further files, such as a user's effects.

    Raises:
        RunError: one of the others can't be read.
    """
    root = Path(__file__).parent
    # In the source tree some of the package's folders lie beside this one.
    places = [(base := root if (root / part).exists() else root.parent, base / part) for part in parts]
    found = [(base, f) for base, place in places for f in ([place] if place.suffix == ".py" else place.rglob("*.py"))]
    # By their place in the package, so that a source tree and what is installed of it have the same.
    files = [file for _, file in sorted((file.relative_to(base).as_posix(), file) for base, file in found)]
    digest = hashlib.sha256()
    try:
        for file in (*files, *map(Path, others)):
            contents = file.read_bytes()
            digest.update(f"{file.name} {len(contents)}\n".encode() + contents)
    except OSError as error:
        raise RunError(f"{error.filename}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()[:16]


def code_of(effects: Iterable[str]) -> str:
    """Digest of the code that decides features, users' own effects in it."""
    return code_digest(others=own_files(effects))


def own_files(effects: Iterable[str]) -> list[str]:
    """Of effects' names those that are a user's own files."""
    return [name for name in effects if name.endswith(".py")]
