"""A step of Adam on many tables: the launches of :mod:`warp_splat.kernels.adam`, on a CPU or a GPU."""

from functools import partial
from itertools import chain

import torch
import warp as wp

from warp_splat.kernels.adam import make_adam
from warp_splat.kernels.cuda import adam_by_number as numbered
from warp_splat.kernels.simd import LANES, Types
from warp_splat.raster.drivers import driver_of
from warp_splat.runtime.launch import launch, launch_in_lanes, load, view

HALF = torch.bfloat16
KEY = 0x9E3779B1  # odd: what differs stays different times it
MOST = 2**30  # numbers of a table in a launch on a GPU


def load_adam(device: torch.device, sparse: bool, halves: bool) -> None:
    """Compile and load what :func:`move` launches on ``device``."""
    lanes = {LANES, 1} if driver_of(device).lanes > 1 else ()
    for kernel in [make_adam(size, sparse, halves) for size in lanes] or [numbered.make_adam_by_number(sparse, halves)]:
        load(kernel, device)


def move(
    tables: list[list[torch.Tensor]], numbers: list, count: int, radii: torch.Tensor | None, iteration: int
) -> None:
    """Change tables of ``count`` rows in place.

    A core follows few streams of memory at a time: all tables together take twice as long. A GPU takes them together.
    """
    keys = [KEY * (len(tables) * iteration + table) % 2**31 for table in range(len(tables))]
    together, lanes = list(zip(tables, numbers, keys, strict=True)), driver_of(tables[0][0].device).lanes
    launch_some, at_once = (_launch, 1) if lanes > 1 else (_launch_numbers, numbered.AT_ONCE)
    for begin in range(0, len(together), at_once):
        launch_some(*map(list, zip(*together[begin : begin + at_once], strict=True)), count, radii)


def _launch(tables: list, numbers: list, keyed: list[int], count: int, radii: torch.Tensor | None) -> None:
    """On a CPU; ``keyed``: keys for rounding at random."""
    sizes = [table[0].numel() // count for table in tables]
    widths, keys = (torch.tensor(values, dtype=torch.int32, device="cpu") for values in (sizes, keyed))
    of_tables = torch.tensor(numbers, dtype=torch.float32, device="cpu")

    def addresses(_types: Types, rows: slice):
        return view(torch.tensor(_addresses(tables, sizes, rows.start), dtype=torch.int64, device="cpu"), wp.uint64)

    def shown(_types: Types, rows: slice):
        return view(widths if radii is None else radii[rows], wp.int32)

    inputs = [lambda _types, rows: rows.start, *(view(table, wp.int32) for table in (widths, keys))]
    inputs += [view(of_tables, wp.float32), shown]
    make = partial(make_adam, sparse=radii is not None, halves=tables[0][-1].dtype == HALF)
    launch_in_lanes(make, LANES, count, inputs, [addresses])


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
    of_all += [numbered.mat_numbers(*chain(*numbers), *[0.0] * 7 * missing), view(shown, wp.int32)]
    for start in range(0, count, MOST // max(widths)):
        rows = min(count - start, MOST // max(widths))
        outputs = [numbered.mat_addresses(*chain(*_addresses(tables, widths, start)), *[0] * 4 * missing)]
        launch(kernel, rows * max(widths), [start, rows, *of_all], outputs, device=device)
