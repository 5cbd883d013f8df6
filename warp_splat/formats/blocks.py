"""Checkpoints of Gaussians in blocks: each process writes a file of its own, and the checkpoint names them all.

The checkpoint is written last, when all blocks are on the disk, and is a file as any other but for the Gaussians. Any
number of processes goes on from it, also one; and any number goes on from a checkpoint that is one file.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from warp_splat.errors import InputError
from warp_splat.formats.checkpoint import EXPECTED, Checkpoint, load_checkpoint, save_checkpoint
from warp_splat.formats.files import Unexpected, reading
from warp_splat.runtime.distributed import Processes
from warp_splat.runtime.rows import Rows

OF_VIEWS = "statistics."  # with a column for each Gaussian
#: With a row for each, but those.
OF_GAUSSIANS = re.compile(
    r"(parameters|gradients|exp_avg|exp_avg_sq)\.(means|sh_dc|sh_rest|opacities|scales|quats)|radii|statistics\.\w+"
)
BLOCKS = "blocks"  # among the facts of a checkpoint: the names of files beside it, and the Gaussians in each


def save_in_blocks(processes: Processes, path: Path, arrays: Mapping[str, np.ndarray], facts: Mapping) -> None:
    """Write a checkpoint of all processes, which call this together, and remove the blocks of the one before.

    Raises:
        InputError: if one cannot write its block: in all; the checkpoint before stays whole. If the first one cannot
            write the rest: in that.
    """
    stem, refused = f"{path.stem}-{facts['iteration']}", None
    names = [f"{stem}-{rank}-of-{processes.count}{path.suffix}" for rank in range(processes.count)]
    own = {name: array for name, array in arrays.items() if OF_GAUSSIANS.fullmatch(name)}
    try:
        save_checkpoint(path.with_name(names[processes.rank]), own, {"iteration": facts["iteration"]})
    except InputError as error:
        refused = error
    counts = processes.gather(torch.tensor([-1 if refused else len(arrays["radii"])]))[:, 0].tolist()
    if min(counts) < 0:
        which = f"process {counts.index(-1)} could not write its block; see its message"
        raise refused or InputError(f"{path}: it stays as it was, since {which}.")
    if processes.rank == 0:
        rest = {name: array for name, array in arrays.items() if name not in own}
        save_checkpoint(path, rest, {**facts, BLOCKS: dict(zip(names, counts, strict=True))})
        for old in path.parent.glob(f"{path.stem}-*-of-*{path.suffix}"):
            if old.name not in names:
                old.unlink(missing_ok=True)


def load_own(path: str | Path, rows: Rows) -> Checkpoint:
    """:func:`load_checkpoint`, of one file or of blocks: of the Gaussians, what this process holds of ``rows``.

    Raises:
        InputError: as that does, or if a block is missing or of another checkpoint.
    """
    whole = load_checkpoint(path)
    if BLOCKS not in whole.facts and not rows.sharded:
        return whole
    blocks = whole.facts.get(BLOCKS, {whole.path.name: len(whole.arrays.get("radii", ()))})
    with reading(whole.path, EXPECTED):
        if not isinstance(blocks, dict) or not all(Path(n).name == n and type(blocks[n]) is int for n in blocks):
            raise Unexpected("one of other blocks")
        own, end, taken = rows.own(sum(blocks.values())), 0, []
        for name, count in blocks.items():
            first, last, end = max(own.start - end, 0), min(own.stop - end, count), end + count
            if first < last:
                block = whole if name == whole.path.name else load_checkpoint(whole.path.with_name(name))
                found = {n: np.atleast_1d(array) for n, array in block.arrays.items() if OF_GAUSSIANS.fullmatch(n)}
                if block.count("iteration") != whole.count("iteration") or (taken and found.keys() != taken[0].keys()):
                    raise Unexpected(f"one whose block {name} is that of another")
                taken.append(
                    {n: a[..., first:last] if n.startswith(OF_VIEWS) else a[first:last] for n, a in found.items()}
                )
        if not taken:
            raise Unexpected("one without Gaussians")
        axes = {n: -1 if n.startswith(OF_VIEWS) else 0 for n in taken[0]}
        arrays = {n: np.concatenate([part[n] for part in taken], axis) for n, axis in axes.items()}
    return replace(whole, arrays={**whole.arrays, **arrays})
