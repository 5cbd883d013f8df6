"""The one exception that a user's mistake may raise: its text is all they see."""

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

REASON_MOST = 300  # characters of a library's own words: on a damaged file, OpenImageIO may list all that it met


class InputError(ValueError):
    """Bad input. The message is one sentence: the file or argument, what was expected, what was found, what to do."""


def tell(error: InputError | OSError) -> None:
    """Print the sentence. Raises ``error`` itself where WARP_SPLAT_TRACEBACK is set."""
    if os.environ.get("WARP_SPLAT_TRACEBACK"):
        raise error
    text = f"{error.filename or 'file or output'}: {error.strerror or error}." if isinstance(error, OSError) else error
    print(f"warp-splat: error: {text}", file=sys.stderr, flush=True)


def imported(package: str, problem: str) -> Any:
    """A package that not everybody has. Raises InputError with this sentence where it is not installed."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(problem) from error


def reason_of(error: object) -> str:
    """A library's own words as a part of one sentence: on one line, not longer than a reader will bear."""
    words = " ".join(str(getattr(error, "strerror", None) or error).split()).rstrip(".")
    return (words if len(words) <= REASON_MOST else words[:REASON_MOST] + " ...") or "no reason given"


@contextmanager
def refusing(kinds: type[Exception] | tuple[type[Exception], ...], problem: str, advice: str = ".") -> Iterator[None]:
    """Turn errors of these ``kinds`` into an InputError: the problem, its reason in brackets, the end of the sentence.

    Raises:
        InputError: as that, or of the block's own, which stays as it is.
    """
    try:
        yield
    except InputError:
        raise
    except kinds as error:
        raise InputError(f"{problem} ({reason_of(error)}){advice}") from error
