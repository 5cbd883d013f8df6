"""What all readers of strangers' files share: one clear sentence for anything that is wrong with a file."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from warp_splat.errors import InputError

LARGEST_RATIO = 64  # of packed to compressed bytes; files of real scenes reach 3
SMALLEST_LIMIT = 2**24  # bytes that any file may expand to


class Unexpected(Exception):
    """A file is of another kind than expected; the text is what was found instead, a part of the sentence."""


@contextmanager
def reading(path: str | Path, expected: str) -> Iterator[None]:
    """Turn what goes wrong in the block into an InputError about ``path``; NumPy does not warn in it.

    What is not finite, or no longer is, the caller leaves out.

    Args:
        path: the file that is read.
        expected: what it should be: "a PLY file with ...".

    Raises:
        InputError: if the block raises it, ``Unexpected``, ValueError or RecursionError (damaged), OSError or
            MemoryError.
    """
    try:
        with np.errstate(all="ignore"):
            yield
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path.") from error
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror or error}).") from error
    except MemoryError as error:
        raise InputError(f"{path}: could not be read ({error}); it needs more memory than there is.") from error
    except Unexpected as error:
        raise InputError(f"{path}: expected {expected}, found {error}.") from error
    except (ValueError, OverflowError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else f"{error!s:.200}"
        raise InputError(f"{path}: the file is damaged or cut short ({reason}); copy or save it again.") from error


def check_expansion(count: int, bytes_each: int, file_bytes: int) -> None:
    """Refuse a compressed file that says it holds more than real ones expand to, before anything is allocated.

    Args:
        count: the Gaussians that it announces.
        bytes_each: of each before compression.
        file_bytes: of the file.
    """
    limit = max(SMALLEST_LIMIT, LARGEST_RATIO * file_bytes)
    if count * bytes_each > limit:
        raise ValueError(f"{count} Gaussians expand to {count * bytes_each} bytes, over {limit}")


def json_object(text: bytes) -> dict:
    """The JSON object that ``text`` is; what JSON does not know, as NaN, is refused."""

    def refuse(name: str):
        raise ValueError(f"the JSON holds {name}")

    parsed = json.loads(text.decode("utf-8"), parse_constant=refuse)
    if not isinstance(parsed, dict):
        raise Unexpected("JSON that is no object")
    return parsed


def entries_of(entry: dict, key: str) -> list:
    """The list that an object holds under ``key``, empty if it has none."""
    found = entry.get(key, [])
    if not isinstance(found, list):
        raise Unexpected(f"{key} that are no list")
    return found


def numbers_of(entry: dict, key: str, count: int) -> np.ndarray:
    """The ``count`` finite numbers that an object holds under ``key``, float64."""
    values = entries_of(entry, key)
    if len(values) != count or not all(isinstance(value, int | float) for value in values):
        raise Unexpected(f"{key} that are not {count} numbers")
    array = np.array([float(value) for value in values])
    if not np.isfinite(array).all():
        raise ValueError(f"{key} that are not finite")
    return array


def whole_number(value: Any, what: str, most: int) -> int:
    """``value`` if it is a whole number, 0 to ``most``."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise Unexpected(f"{what} {value!r:.40}, which is no whole number")
    if not 0 <= value <= most:
        raise ValueError(f"{what} {value if abs(value) < 10**18 else 'of many digits'}, at most {most} is there")
    return value
