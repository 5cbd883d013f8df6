"""Files, read and written. What all readers of strangers' files share: one clear sentence for anything that is wrong.

Files are written beside their final name and moved there when complete: a reader never sees half a file.
"""

import csv
import errno
import io
import json
import os
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warp_splat.errors import InputError

T = TypeVar("T")
FULL = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of ``path``; what was written there becomes ``path`` if the block succeeds.

    Missing folders are created. The temporary name keeps the suffix, by which image writers choose their format. If the
    block raises, the temporary file is removed and an older ``path`` stays as it was.

    Args:
        path: the file to write or to replace.

    Raises:
        InputError: if the operating system refuses: disk full, folder not writable, a file where a folder should be.
    """
    path = Path(path)
    temporary = path.with_name(f".tmp-{uuid.uuid4().hex[:12]}{path.suffix}")
    try:
        if path.is_dir() and not path.is_symlink():  # before files that belong to it are written
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        # Some file systems report a full disk only here; without it a power cut could leave an empty file.
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        older = "; an older file of this name is untouched" if os.path.isfile(path) else ""
        raise InputError(
            f"{path}: could not be written ({error.strerror or error}){older}. "
            f"{'Free some space or choose' if error.errno in FULL else 'Choose'} another folder."
        ) from error
    finally:
        with suppress(OSError):  # failing to tidy up must not hide the error that made it necessary
            temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text, whole or not at all.

    Raises:
        InputError: if the file cannot be written.
    """
    write_bytes(path, text.encode("utf-8", "surrogateescape"))  # names of files may be any bytes


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write bytes, whole or not at all.

    Raises:
        InputError: if the file cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def write_array(path: str | Path, values: np.ndarray) -> None:
    """Write ``values`` as NumPy does, whole or not at all.

    Raises:
        InputError: if the file cannot be written.
    """
    content = io.BytesIO()
    np.save(content, values)  # to a file, NumPy does not tell when the end is missing
    write_bytes(path, content.getvalue())


def write_json(path: str | Path, value) -> None:
    """Write ``value`` as JSON, whole or not at all; numbers that are not finite, which JSON lacks, become ``null``.

    Raises:
        InputError: if the file cannot be written.
    """
    finite = json.loads(json.dumps(value), parse_constant=lambda name: None)
    write_text(path, json.dumps(finite, indent=1, allow_nan=False))


def write_csv(path: str | Path, rows: Sequence[Mapping]) -> None:
    """Write records as CSV, whole or not at all, with a column for each key that any of them has.

    Raises:
        InputError: if the file cannot be written.
    """
    with atomic_write(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
        writer.writeheader()
        writer.writerows(rows)


def save_somewhere(path: Path, save: Callable[[Path], object], name: str = "") -> Path:
    """Let ``save`` write a file; if that fails, into the system's folder for temporary files, as ``name`` or its own.

    Returns:
        Where it is.

    Raises:
        InputError, OSError: if that fails, too.
    """
    try:
        save(path)
    except (InputError, OSError) as error:
        from tqdm import tqdm  # noqa: PLC0415 - a training's bar may be shown

        tqdm.write(f"warning: {error}", file=sys.stderr)
        path = Path(tempfile.mkdtemp(prefix="warp_splat-")) / (name or path.name)
        save(path)
        tqdm.write(f"It was saved as {path} instead.", file=sys.stderr)
    return path


LARGEST_RATIO = 64  # of packed to compressed bytes; files of real scenes reach 3
SMALLEST_LIMIT = 2**24  # bytes that any file may expand to


class Unexpected(Exception):
    """A file is of another kind than expected; the text is what was found instead, a part of the sentence."""


@contextmanager
def reading(path: str | Path, expected: str, *damage: type[Exception]) -> Iterator[None]:
    """Turn what goes wrong in the block into an InputError about ``path``; NumPy does not warn in it.

    What is not finite, or no longer is, the caller leaves out.

    Args:
        path: the file that is read.
        expected: what it should be: "a PLY file with ...".
        damage: what a library raises for a file that is damaged, besides ValueError and RecursionError.

    Raises:
        InputError: if the block raises it, ``Unexpected``, ``damage``, OSError or MemoryError.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except InputError:
        raise
    except io.UnsupportedOperation as error:  # a ValueError as well
        raise InputError(f"{path}: could not be read ({error}).") from error
    except (ValueError, OverflowError, RecursionError, *damage) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)[:200] or type(error).__name__
        raise InputError(f"{path}: the file is damaged or cut short ({reason}); copy or save it again.") from error
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path.") from error
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror or error}).") from error
    except MemoryError as error:
        raise InputError(f"{path}: could not be read ({error}); it needs more memory than there is.") from error
    except Unexpected as error:
        raise InputError(f"{path}: expected {expected}, found {error}.") from error


def read_json(path: Path, expected: str, parse: Callable[[Any], T]) -> T:
    """What ``parse`` makes of the JSON of a file.

    Raises:
        InputError: if there is no such file, it is damaged, or ``parse`` finds something else than ``expected``.
    """
    with reading(path, expected):
        try:
            return parse(json.loads(path.read_text(encoding="utf-8")))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise Unexpected(f"other JSON ({error!s:.100})") from error


def read_optional_json(path: Path, expected: str, parse: Callable[[Any], T]) -> T | None:
    """:func:`read_json` of a file that there may be; None without it."""
    return read_json(path, expected, parse) if path.exists() else None


def check_expansion(count: int, bytes_each: int, file_bytes: int) -> None:
    """Refuse a compressed file that says it holds more than real ones expand to, before anything is allocated.

    Args:
        count: the Gaussians that it announces.
        bytes_each: of each before compression.
        file_bytes: of the file.
    """
    if count * bytes_each > (limit := max(SMALLEST_LIMIT, LARGEST_RATIO * file_bytes)):
        raise ValueError(f"{count} Gaussians expand to {count * bytes_each} bytes, over {limit}")


def json_object(text: bytes) -> dict:
    """The JSON object that ``text`` is; what JSON does not know, as NaN, is refused."""

    def refuse(name: str):
        raise ValueError(f"the JSON holds {name}")

    if not isinstance((parsed := json.loads(text.decode("utf-8"), parse_constant=refuse)), dict):
        raise Unexpected("JSON that is no object")
    return parsed


def entries_of(entry: dict, key: str) -> list:
    """The list that an object holds under ``key``, empty if it has none."""
    if not isinstance((found := entry.get(key, [])), list):
        raise Unexpected(f"{key} that are no list")
    return found


def numbers_of(entry: dict, key: str, count: int) -> np.ndarray:
    """The ``count`` finite numbers that an object holds under ``key``, float64."""
    values = entries_of(entry, key)
    if len(values) != count or not all(isinstance(value, int | float) for value in values):
        raise Unexpected(f"{key} that are not {count} numbers")
    if not np.isfinite(array := np.array([float(value) for value in values])).all():
        raise ValueError(f"{key} that are not finite")
    return array


def whole_number(value: Any, what: str, most: int) -> int:
    """``value`` if it is a whole number, 0 to ``most``."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise Unexpected(f"{what} {value!r:.40}, which is no whole number")
    if not 0 <= value <= most:
        raise ValueError(f"{what} {value if abs(value) < 10**18 else 'of many digits'}, at most {most} is there")
    return value
