"""Reading numbers, words and paths out of JSON and CSV, so that each fault names its file and field."""

from __future__ import annotations

import csv
import difflib
import json
import math
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from PIL import Image

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError

Value = TypeVar("Value")

_ALIKE = 0.8  # difflib's ratio of two words one of which is the other misspelt: a letter of five, two of ten
_LARGEST = float(np.finfo(np.float32).max)  # the simulation's numbers are single precision
_LONGEST_NAME = 60  # characters, of four bytes at most, where a file's name has 255 bytes and more is added


class Fields:
    """A JSON object of a file, with the way that led to it.

    Every reader raises MeasurementError, naming the file and the field's full path (``bed.upper[2]``).
    """

    def __init__(self, data: dict[str, Any], file: Path, prefix: str = "", parent: Fields | None = None) -> None:
        self.data = data
        self.file = file
        self.prefix = prefix
        self.parent = parent

    @classmethod
    def read(cls, file: Path) -> Fields:
        """The object that a JSON file holds."""
        data = read_json(file)
        if not isinstance(data, dict):
            raise MeasurementError(f"expected a JSON object, found {_kind(data)}", file=file)
        return cls(data, file)

    def path_of(self, key: str) -> str:
        """Full name of a field, as errors show it."""
        return f"{self.prefix}.{key}" if self.prefix else key

    def fail(self, key: str, message: str) -> NoReturn:
        """Raise MeasurementError about a field of this object, or of the enclosing one that the value came from."""
        name = key.split("[")[0]
        if self.parent is not None and self.data.get(name) is None and self.parent.has(name):
            self.parent.fail(key, message)
        raise MeasurementError(message, file=self.file, field=self.path_of(key))

    def has(self, key: str) -> bool:
        """Whether the field is there, here or in the enclosing object it falls back to, and not null."""
        return self._find(key) is not None

    def raw(self, key: str) -> Any:
        """The value as JSON has it; missing or null is an error."""
        value = self._find(key)
        if value is None:
            self.fail(key, "missing; the format requires it")
        return value

    def child(self, key: str) -> Fields:
        """A nested object."""
        return Fields(self._typed(key, dict, "an object"), self.file, self.path_of(key))

    def children(self, key: str) -> Iterator[Fields]:
        """The objects of a non-empty list; fields missing in them are looked up in this object."""
        value = self._typed(key, list, "a list")
        if not value:
            self.fail(key, "the list is empty")
        for i, item in enumerate(value):
            name = f"{key}[{i}]"
            if not isinstance(item, dict):
                self.fail(name, f"expected an object, found {_kind(item)}")
            yield Fields(item, self.file, self.path_of(name), parent=self)

    def check_names(self, known: Iterable[str]) -> None:
        """Raise MeasurementError about a field that is none of those known, but spelt like one that isn't given."""
        absent = [name for name in known if not self.has(name)]
        for key in self.data:
            meant = difflib.get_close_matches(key.lower().replace("-", "_"), absent, n=1, cutoff=_ALIKE)
            if meant and key not in known:
                self.fail(key, f"no field is called so; did you mean {meant[0]!r}?")

    def names(self) -> list[str]:
        """All fields' names, those of the enclosing object that values fall back to included."""
        return [*self.data, *(self.parent.names() if self.parent is not None else ())]

    def flag(self, key: str) -> bool:
        """True or false."""
        return self._typed(key, bool, "true or false")

    def text(self, key: str) -> str:
        """A non-empty string."""
        value = self._typed(key, str, "text")
        if not value.strip():
            self.fail(key, f"expected text, found {_kind(value)}")
        return value

    def name(self, key: str, default: str | None = None) -> str:
        """A string that can be part of a file's name, as those of results made from a set are."""
        value = default if default is not None and not self.has(key) else self.text(key)
        if not value.isprintable() or set(value) & set("/\\") or value.startswith(".") or len(value) > _LONGEST_NAME:
            self.fail(
                key,
                f"{value[:40]!r} names files: at most {_LONGEST_NAME} characters, none of them a slash, a backslash or"
                " unprintable, nor a point at the beginning",
            )
        return value

    def number(
        self, key: str, lower: float = -math.inf, upper: float = math.inf, default: float | None = None, hint: str = ""
    ) -> float:
        """A finite number within [lower, upper]; ``hint`` is appended to the message when it is outside."""
        if default is not None and not self.has(key):
            return default
        number = self._finite(key, self.raw(key))
        if not lower <= number <= upper:
            self.fail(key, f"{number:g} lies outside [{lower:g}, {upper:g}]{hint and '; ' + hint}")
        return number

    def integer(self, key: str, lower: int, upper: int) -> int:
        """A whole number within [lower, upper]."""
        number = self.number(key, lower, upper)
        if number != int(number):
            self.fail(key, f"expected a whole number, found {number:g}")
        return int(number)

    def vector(self, key: str, length: int) -> FloatArray:
        """A list of ``length`` finite numbers."""
        value = self.raw(key)
        if not isinstance(value, list) or len(value) != length:
            self.fail(key, f"expected a list of {length} numbers, found {_kind(value)}")
        return np.array([self._finite(f"{key}[{i}]", v) for i, v in enumerate(value)])

    def matrix(self, key: str, rows: int, columns: int) -> FloatArray:
        """A list of ``rows`` lists of ``columns`` finite numbers."""
        value = self.raw(key)
        shaped = isinstance(value, list) and len(value) == rows
        if not shaped or not all(isinstance(row, list) and len(row) == columns for row in value):
            self.fail(key, f"expected a {rows} x {columns} matrix (a list of {rows} lists of {columns} numbers)")
        return np.array(
            [[self._finite(f"{key}[{i}][{j}]", v) for j, v in enumerate(row)] for i, row in enumerate(value)]
        )

    def path(self, key: str, root: Path, base: Path) -> Path:
        """An existing file named relative to ``base`` that lies inside ``root``, also after following links."""
        return inside(self.text(key), root, base, self.file, self.path_of(key))

    def _find(self, key: str) -> Any:
        value = self.data.get(key)
        if value is None and self.parent is not None:
            return self.parent._find(key)
        return value

    def _typed(self, key: str, kind: type[Value], expected: str) -> Value:
        value = self.raw(key)
        if not isinstance(value, kind):
            self.fail(key, f"expected {expected}, found {_kind(value)}")
        return value

    def _finite(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(key, f"expected a number, found {_kind(value)}")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not abs(number) <= _LARGEST:
            self.fail(key, f"{number:g} is not a finite number of single precision")
        return number


def inside(name: str, root: Path, base: Path, file: Path, field: str) -> Path:
    """The existing file ``name`` (relative to ``base``), which must lie inside ``root`` after following links.

    Raises:
        MeasurementError: about ``field`` of ``file`` when the path leaves the folder or is unusable, else about the
            missing file itself.
    """
    path = named(name, base, file, field)
    try:
        leaves = Path(name).is_absolute() or not path.resolve().is_relative_to(root.resolve())
        found, is_file = path.exists(), path.is_file()
    except (OSError, ValueError, RuntimeError) as error:  # name too long, null character, loop of links
        raise MeasurementError(f"{name[:80]!r} is no usable path ({error})", file=file, field=field) from error
    if leaves:
        raise MeasurementError(
            f"{name!r} leaves the measurement set; put the file into the folder and name it relatively",
            file=file,
            field=field,
        )
    if not found:
        raise MeasurementError(f"no such file, though {file.name} names it", file=path, field=field)
    if not is_file:
        raise MeasurementError(f"{name!r} is not a file", file=file, field=field)
    return path


def named(name: str, base: Path, file: Path, field: str) -> Path:
    """Where ``name`` is, relative to ``base``: as it stands, by Windows' backslashes, in another of Unicode's normal
    forms, or an image without its suffix.

    Raises:
        MeasurementError: several images have the name.
    """
    path = base / name
    try:
        if path.exists():
            return path
        other = base / name.replace("\\", "/")
        if other.exists():
            return other
        known, wanted = Image.registered_extensions(), _composed(other.name)
        found = [
            p
            for p in other.parent.iterdir()
            if wanted == _composed(p.name) or (wanted == _composed(p.stem) and p.suffix.lower() in known)
        ]
    except (OSError, ValueError):
        return path
    if len(found) > 1:
        several = ", ".join(sorted(p.name for p in found))
        raise MeasurementError(f"{name!r} lacks its suffix, and there are {several}", file=file, field=field)
    return found[0] if found else other


def _composed(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def read_json(file: Path) -> Any:
    """What a JSON file holds; MeasurementError when it is missing, unreadable, not JSON, or gives a key twice."""
    text = read_text(file)
    try:
        return json.loads(text, object_pairs_hook=_once)
    except json.JSONDecodeError as error:
        rest = text[error.pos :]
        fault = error.msg
        if rest.startswith(("//", "/*", "#")):
            fault = "JSON has no comments, but there is one"
        elif rest[:1] in ("}", "]") and text[: error.pos].rstrip().endswith(","):
            fault = "a comma stands before the closing bracket"
        raise MeasurementError(f"not JSON: {fault} in line {error.lineno}, column {error.colno}", file=file) from error
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits, endless nesting
        raise MeasurementError(f"not usable JSON: {error}", file=file) from error


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The object of these pairs, whose keys must differ."""
    out = dict(pairs)
    if len(out) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)!r} is given twice")
    return out


def read_text(file: Path) -> str:
    """A UTF-8 text file's content; MeasurementError when it is missing, unreadable or not text."""
    try:
        return file.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise MeasurementError("no such file", file=file) from error
    except UnicodeDecodeError as error:
        raise MeasurementError("not a text file (it is not UTF-8)", file=file) from error
    except (OSError, ValueError) as error:  # also a path with a null character
        raise MeasurementError(f"cannot be read ({error})", file=file) from error


def read_table(file: Path, columns: Sequence[str]) -> FloatArray:
    """The numbers of `read_labelled`, of a table without labels."""
    return read_labelled(file, (), columns)[1]


def read_labelled(
    file: Path, labels: Sequence[str], columns: Sequence[str]
) -> tuple[list[tuple[str, ...]], FloatArray]:
    """A CSV file with a header that has ``labels`` and ``columns``: non-empty text of each row, and (rows, columns)
    finite numbers; at least one row.

    Columns may be in any order, in capitals, and among others, which are left out. Cells are parted by commas, tabs or
    semicolons; by the latter two, numbers may have decimal commas, or points, but not both. Lines that begin with # are
    comments, or the header.

    Raises:
        MeasurementError: naming the line and column.
    """
    wanted = (*labels, *columns)
    places: dict[str, int] | None = None
    names: list[str] = []
    delimiter = ","
    texts: list[tuple[str, ...]] = []
    table: list[list[float]] = []
    marks: set[str] = set()
    for line, text in enumerate(read_text(file).splitlines(), start=1):
        is_comment = text.lstrip().startswith("#")
        if not text.strip() or (is_comment and places is not None):
            continue
        if places is None:
            delimiter = next((mark for mark in ";\t" if mark in text), ",")
        cells = _cells(text.lstrip(" #") if is_comment else text, delimiter, file)
        if not any(cells):
            continue
        if places is None:
            names = [cell.lower() for cell in cells]
            while not names[-1]:
                names.pop()
            faulty = [name for name in wanted if names.count(name) != 1]
            if not faulty:
                places = {name: names.index(name) for name in wanted}
            elif not is_comment:
                raise _no_header(wanted, ",".join(cells)[:80], faulty, file, line)
            continue
        if len(cells) < len(names) or any(cells[len(names) :]):
            raise MeasurementError(
                f"{len(cells)} values where the header has {len(names)}", file=file, field=f"line {line}"
            )
        texts.append(tuple(cells[places[name]] for name in labels))
        if not all(texts[-1]):
            raise MeasurementError(f"{' and '.join(labels)} must not be empty", file=file, field=f"line {line}")
        numbers = [cells[places[name]] for name in columns]
        marks |= set(",.") & set("".join(numbers))
        if len(marks) > 1:
            raise MeasurementError("numbers have decimal points and commas; use one", file=file, field=f"line {line}")
        if delimiter != ",":
            numbers = [text.replace(",", ".") for text in numbers]
        table.append([_cell(text, file, f"{name}, line {line}") for name, text in zip(columns, numbers, strict=True)])
    if places is None:
        raise _no_header(wanted, "nothing", wanted, file, 1)
    if not table:
        raise MeasurementError("the table has no rows", file=file)
    return texts, np.array(table)


def _no_header(columns: Sequence[str], found: str, faulty: Sequence[str], file: Path, line: int) -> MeasurementError:
    return MeasurementError(
        f"expected the header {','.join(columns)}, found {found}; {', '.join(faulty)} must be there once",
        file=file,
        field=f"line {line}",
    )


def _cells(text: str, delimiter: str, file: Path) -> list[str]:
    """The cells of a line, without space around them."""
    try:
        return [cell.strip() for row in csv.reader([text], delimiter=delimiter, skipinitialspace=True) for cell in row]
    except csv.Error as error:
        raise MeasurementError(f"not a CSV table: {error}", file=file) from error


def _cell(text: str, file: Path, field: str) -> float:
    try:
        number = float(text.replace("_", "?"))  # Python's grouping of digits is no one else's
    except ValueError as error:
        raise MeasurementError(f"{text[:40]!r} is not a number", file=file, field=field) from error
    if not abs(number) <= _LARGEST:
        raise MeasurementError(f"{text} is not a finite number of single precision", file=file, field=field)
    return number


def _kind(value: Any) -> str:
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return json.dumps(value)[:40]
