"""pycolmap where it is installed, else None: it has no wheel for Linux on ARM."""

import signal
import threading

try:
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))  # its own would print a stack of C++
except ImportError:
    pycolmap = None  # type: ignore
import OpenImageIO  # noqa: F401 - after pycolmap, whose libraries clash with its own, writing a PNG would crash

from warp_splat.errors import InputError


def require_pycolmap(what: str) -> None:
    """Raise InputError if pycolmap, which ``what`` needs, is not installed."""
    if pycolmap is None:
        raise InputError(
            f"{what}: expected an installed pycolmap, found none, and for Linux on ARM there is none; use another "
            "machine, or a scene with transforms.json and pinhole cameras."
        )
