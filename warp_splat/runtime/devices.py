"""Which device a run uses, why a GPU cannot be used, and what to say when memory runs out."""

import re
import sys
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager, suppress
from pathlib import Path

import torch
import warp as wp

from warp_splat.camera import Camera
from warp_splat.errors import InputError, refusing

OUT_OF_MEMORY = ("out of memory", "not enough memory", "can't allocate memory", "Failed to allocate")


def choose_device(name: str) -> torch.device:
    """The device called "cpu" or "cuda"; for "auto", a GPU if one can be used.

    Raises:
        InputError: if "cuda" cannot be used here; the message says why and what to do.
    """
    if name != "cpu":
        if (problem := why_no_cuda()) is None:
            return torch.device("cuda", torch.cuda.current_device())
        if name == "cuda":
            raise InputError(f"--device cuda: {problem}, or use --device cpu.")
    return torch.device("cpu")


#: For what begins to use Warp. Only then does it look for a folder.
kernels_kept = refusing(OSError, "WARP_CACHE_PATH or ~/.cache: expected a folder for compiled kernels", "; name one.")


@kernels_kept
def why_no_cuda() -> str | None:
    """What keeps kernels from running on a GPU here, and what to do about it; None if nothing does."""
    if torch.version.cuda is None:
        return f"torch {torch.__version__} was built without CUDA; install a build with it (pytorch.org says how)"
    driver, toolkit = wp.get_cuda_driver_version(), wp.get_cuda_toolkit_version()
    built = f"torch {torch.__version__} was built for CUDA {torch.version.cuda}"
    if toolkit is None:
        return f"Warp {wp.__version__} was built without CUDA; install warp-lang from PyPI"
    built += f", Warp {wp.__version__} for CUDA {_dotted(toolkit)}"
    if driver is None:
        return f"no NVIDIA driver found ({built}); install NVIDIA's driver"
    if not (torch.cuda.is_available() and wp.is_cuda_available()):
        if driver[0] < max(int(torch.version.cuda.split(".")[0]), toolkit[0]):  # minor versions are compatible
            return f"the NVIDIA driver is too old: it supports CUDA {_dotted(driver)}, but {built}; update the driver"
        return (
            f"the NVIDIA driver (for CUDA {_dotted(driver)}) shows no GPU ({built}); see what nvidia-smi says and "
            "whether CUDA_VISIBLE_DEVICES hides it"
        )
    try:
        torch.zeros(1, device="cuda").item()
    except RuntimeError as error:
        if is_out_of_memory(error):
            return "the GPU's memory is full; end other programs that use it (nvidia-smi lists them)"
        return f"the GPU does not answer torch {torch.__version__} ({str(error).splitlines()[0]}); update the driver"
    return None


def _dotted(version: tuple[int, int]) -> str:
    return f"{version[0]}.{version[1]}"


@contextmanager
def memory_explained(device: torch.device, gaussians: Sized, cameras: Iterable[Camera], advice: str) -> Iterator[None]:
    """Turn an error that means that memory ran out into an InputError that says where, and what takes less.

    Args:
        device: where the work is done.
        gaussians: those at work when the error comes are counted.
        cameras: those of the images; the size of the largest is told.
        advice: what to do instead, an imperative.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        where = getattr(error, "__notes__", ["between two stages"])[0]
        largest = max(cameras, key=lambda camera: camera.width * camera.height)
        what = f"with {len(gaussians)} Gaussians on {largest.width} x {largest.height} px"
        raise InputError(f"Out of memory on {device.type} {where}, {what}; {advice}.") from error


def is_out_of_memory(error: BaseException) -> bool:
    """Whether ``error`` says that memory ran out: Python's, NumPy's, torch's on either device, or Warp's."""
    if isinstance(error, MemoryError | torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error) for words in OUT_OF_MEMORY)


def peak_memory() -> int | None:
    """Largest resident size of the process so far, in MiB; None where the system does not tell."""
    status = Path("/proc/self/status")  # Linux; what getrusage tells there begins with the peak of the parent process
    if status.exists() and (peak := re.search(r"VmHWM:\s*(\d+) kB", status.read_text())):
        return int(peak[1]) // 1024
    with suppress(ImportError):
        import resource  # noqa: PLC0415 - not on Windows

        unit = 1024 * 1024 if sys.platform == "darwin" else 1024
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // unit
    return None
