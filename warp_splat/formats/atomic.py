"""Files are written beside their final name and moved there when complete: a reader never sees half a file."""

import csv
import errno
import json
import os
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from warp_splat.errors import InputError

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
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            # Some file systems report a full disk only here; without it a power cut could leave an empty file.
            with open(temporary, "r+b") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            with suppress(OSError):  # failing to tidy up must not hide the error that made it necessary
                temporary.unlink(missing_ok=True)
    except OSError as error:
        older = "; an older file of this name is untouched" if os.path.exists(path) else ""
        raise InputError(
            f"{path}: could not be written ({error.strerror or error}){older}. "
            f"{'Free some space or choose' if error.errno in FULL else 'Choose'} another folder."
        ) from error


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
