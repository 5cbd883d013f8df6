"""A step of Adam on many tables: the launches of :mod:`warp_splat.kernels.adam`, on a CPU or a GPU."""

from itertools import chain

import numpy as np
import torch

from warp_splat.kernels.adam import make_adam
from warp_splat.kernels.cuda import adam_by_number as numbered
from warp_splat.kernels.simd import LANES
from warp_splat.raster.drivers import driver_of
from warp_splat.runtime.launch import launch, load
from warp_splat.runtime.pool import falling_shares

HALF = torch.bfloat16
KEY = 0x9E3779B1  # odd: what differs stays different times it
MOST = 2**30  # numbers of a table in a launch on a GPU


def load_adam(device: torch.device, sparse: bool, halves: bool) -> None:
    """Compile and load what :func:`move` launches on ``device``."""
    lanes = {LANES, 1} if driver_of(device).lanes > 1 else ()
    load(device, *[make_adam(n, sparse, halves) for n in lanes] or [numbered.make_adam_by_number(sparse, halves)])


def move(
    tables: list[list[torch.Tensor]], numbers: list, count: int, radii: torch.Tensor | None, iteration: int
) -> None:
    """Change tables of ``count`` rows in place."""
    keys = [KEY * (len(tables) * iteration + table) % 2**31 for table in range(len(tables))]
    if driver_of(tables[0][0].device).lanes > 1:
        return _launch(tables, numbers, keys, count, radii)
    together = list(zip(tables, numbers, keys, strict=True))
    for begin in range(0, len(together), numbered.AT_ONCE):
        _launch_numbers(*map(list, zip(*together[begin : begin + numbered.AT_ONCE], strict=True)), count, radii)


def _launch(tables: list, numbers: list, keys: list[int], count: int, radii: torch.Tensor | None) -> None:
    """On a CPU, sixteen rows at a time, then those left over; ``keys``: for rounding at random."""
    widths, halves = [table[0].numel() // count for table in tables], tables[0][-1].dtype == HALF
    arrays = [np.array(widths, np.int32), np.array(keys, np.int32), np.array(numbers, np.float32)]
    for lanes, start, stop in ((LANES, 0, count - count % LANES), (1, count - count % LANES, count)):
        groups = (stop - start) // lanes
        # by their numbers, which the tables share out among them by their widths; each of a narrow one takes longer
        shares = falling_shares(stop - start) * sum(widths)
        bounds = np.interp(shares, np.cumsum([0, *widths]), range(len(tables) + 1)) * groups
        addresses = np.array(_addresses(tables, widths, start), np.int64)
        inputs = [groups, start, *arrays, arrays[0] if radii is None else radii[start:stop]]
        kernel = make_adam(lanes, radii is not None, halves)
        launch(kernel, len(tables) * groups, inputs, [addresses], bounds=[round(bound) for bound in bounds])


def _addresses(tables: list, widths: list[int], row: int) -> list[list[int]]:
    """Where a row begins in each tensor of each table."""
    pairs = zip(tables, widths, strict=True)
    return [[t.data_ptr() + t.element_size() * width * row for t in table] for table, width in pairs]


def _launch_numbers(tables: list, numbers: list, keys: list[int], count: int, radii: torch.Tensor | None) -> None:
    """On a GPU, as many tables as its kernel takes at once; in one launch, if 32 bits can tell the numbers apart."""
    device, missing = tables[0][0].device, numbered.AT_ONCE - len(tables)
    widths = [table[0].numel() // count for table in tables]
    kernel = numbered.make_adam_by_number(radii is not None, tables[0][-1].dtype == HALF)
    shown = tables[0][0].new_empty(0, dtype=torch.int32) if radii is None else radii
    of_all = [numbered.vec_tables(*values, *[0] * missing) for values in (widths, keys)]
    of_all += [numbered.mat_numbers(*chain(*numbers), *[0.0] * 7 * missing), shown]
    for start in range(0, count, MOST // max(widths)):
        rows = min(count - start, MOST // max(widths))
        outputs = [numbered.mat_addresses(*chain(*_addresses(tables, widths, start)), *[0] * 4 * missing)]
        launch(kernel, rows * max(widths), [start, rows, *of_all], outputs, device=device)
