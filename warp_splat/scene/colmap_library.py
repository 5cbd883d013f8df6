"""pycolmap where it is installed, else None: it has no wheel for Linux on ARM."""

import OpenImageIO  # noqa: F401 - before pycolmap: after it, whose libraries clash with its own, writing a PNG crashes

from warp_splat.errors import InputError
from warp_splat.runtime.interrupts import later

# Ctrl-C while it loads would become its RuntimeError. Of SIGTERM it takes care itself, and prints a stack of C++.
with later():
    try:
        import pycolmap
    except ImportError:
        pycolmap = None  # type: ignore


def require_pycolmap(what: str) -> None:
    """Raise InputError if pycolmap, which ``what`` needs, is not installed."""
    if pycolmap is None:
        raise InputError(
            f"{what}: expected an installed pycolmap, found none, and for Linux on ARM there is none; use another "
            "machine, or a scene with transforms.json and pinhole cameras."
        )
