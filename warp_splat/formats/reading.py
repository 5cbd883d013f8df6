"""What all readers of strangers' files share: one clear sentence for anything that is wrong with a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from warp_splat.errors import InputError


class Unexpected(Exception):
    """A file is of another kind than expected; the text is what was found instead, a part of the sentence."""


@contextmanager
def reading(path: str | Path, expected: str) -> Iterator[None]:
    """Turn what goes wrong in the block into an InputError about ``path``.

    Args:
        path: the file that is read.
        expected: what it should be: "a PLY file with ...".

    Raises:
        InputError: if the block raises it, ``Unexpected``, ValueError or RecursionError (damaged), OSError or
            MemoryError.
    """
    try:
        yield
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path and the iteration.") from error
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror or error}).") from error
    except MemoryError as error:
        raise InputError(f"{path}: could not be read ({error}); it needs more memory than there is.") from error
    except Unexpected as error:
        raise InputError(f"{path}: expected {expected}, found {error}.") from error
    except (ValueError, OverflowError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else f"{error!s:.200}"
        raise InputError(f"{path}: the file is damaged or cut short ({reason}); copy or save it again.") from error
