"""Tensors in files: the system keeps in memory what of them is in use, and writes the rest back."""

import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from warp_splat.errors import InputError


def zeros_in_file(folder: Path, shape: Sequence[int], dtype: torch.dtype) -> torch.Tensor:
    """Zeros of ``shape`` on the CPU, in a file without a name in ``folder`` that goes when the tensor does.

    Raises:
        InputError: if there is no room for it.
    """
    size = dtype.itemsize * math.prod(shape)
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            if hasattr(os, "posix_fallocate"):  # a page without room on the disk would end the process
                os.posix_fallocate(file.fileno(), 0, max(size, 1))
            content = np.memmap(file, np.uint8, "r+" if os.fstat(file.fileno()).st_size else "w+", shape=max(size, 1))
    except OSError as error:
        raise InputError(
            f"{folder}: expected {size / 2**20:.0f} MiB more on its disk for --out_of_core ({error.strerror}); free "
            "some, or choose another folder with -m."
        ) from error
    return torch.from_numpy(content)[:size].view(dtype).view(*shape)
