"""Blocks of a scene that are trained apart: which photographs and points are whose, and one model of all of them.

Cells part the ground at medians of the points: each Gaussian of the merged model has one owner. A block trains on the
photographs that show its cell. It starts from points beyond, too: what they show behind a border is then explained
where it is, not by floaters before it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warp_splat.camera import Camera
from warp_splat.config import MergeConfig
from warp_splat.errors import InputError
from warp_splat.formats.coordinates import read_coordinates, write_coordinates
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.files import read_json, whole_number, write_json
from warp_splat.formats.model_folder import AS_SAVED, CAMERAS, open_model, ply_path, read_cfg_args, write_cfg_args
from warp_splat.formats.ply import load_points, save_points
from warp_splat.formats.splats import concatenated
from warp_splat.scene.types import visible

BLOCK = "block.json"  # in the folder of a training that has ended
SHARE = 0.1  # of what a photograph shows, for a block to train on it
SOME = 1000  # points of a block that tell what a photograph shows
ENDLESS = float(np.finfo(np.float32).max)  # where a cell has no neighbor; JSON has no infinity
COMMON = ("antialiasing", "projection", "white_background", "eval", "sh_degree")  # options of which a model has one


class Block(NamedTuple):
    """One of the cells of a scene."""

    number: int  # from 0
    cells: np.ndarray  # [N, 2, 3] of all blocks, in world coordinates: from (within), and to (without)
    empty: Sequence[int] = ()  # of those, what no photograph shows

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Which of ``points`` [P, 3] lie in it, [P] bool."""
        return _within(self.cells[self.number], points)

    def shown(self, camera: Camera, points: np.ndarray) -> list[bool]:
        """Of each cell, whether a camera is in it, or shows much of it by ``points`` [P, 3]: the nearer, the more."""
        center = camera.center[None]
        some = points[:: max(1, len(points) // (SOME * len(self.cells)))]
        away = np.linalg.norm(some - center, axis=1)
        seen = visible(camera, some) / np.maximum(away, 0.1 * np.median(away)) ** 2
        most = SHARE * seen.sum()
        return [bool(_within(c, center)[0]) or bool(seen[_within(c, some)].sum() > most) for c in self.cells]

    def starts(self, cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
        """Which of ``points`` [P] it starts from: its own, and at most as many others that the cameras show."""
        own, seen = self.holds(points), sum(visible(camera, points) for camera in cameras) > 0
        others = np.flatnonzero(seen & ~own)
        return np.sort(np.append(np.flatnonzero(own), others[:: -(-len(others) // max(1, own.sum())) or 1]))


def _within(cell: np.ndarray, points: np.ndarray) -> np.ndarray:
    return ((cell[0] <= points) & (points < cell[1])).all(1)


def block_of(text: str, points: np.ndarray, cameras: Sequence[Camera], level: bool = False) -> Block:
    """The block K of N that ``text`` "K/N" names, of a scene with ``points`` [P, 3]: the same on every machine.

    Raises:
        InputError: if there is no such block, or one would be without points.
    """
    number, slash, count = (int(word) if word.isdecimal() else word for word in text.partition("/"))
    if not (slash and isinstance(number, int) and isinstance(count, int) and 1 <= number <= count):
        raise InputError(f"--block {text}: expected K/N, K from 1 to N, such as 2/4 for the second of four blocks.")
    up = 1 if level else np.abs(sum(camera.rotation[1] for camera in cameras)).argmax()  # of coordinates, or as shown
    ground = [axis for axis in range(3) if axis != up]

    def cut(points: np.ndarray, cell: np.ndarray, count: int) -> list[np.ndarray]:
        if not len(points):
            raise InputError(f"--block {text}: expected points in every block, found one without; take fewer blocks.")
        if count == 1:
            return [cell]
        ordered, edge = np.sort(points, 0), len(points) // 20  # what lies far out shall not choose the axis
        axis = max(ground, key=lambda axis: ordered[-1 - edge, axis] - ordered[edge, axis])
        middle, (lower, upper) = len(points) * (count // 2) // count, (cell.copy(), cell.copy())
        border = 0.5 * sum(ordered[max(middle - 1, 0) : middle + 1, axis].astype(np.float64))
        lower[1, axis] = upper[0, axis] = border
        below = points[:, axis] < border
        return cut(points[below], lower, count // 2) + cut(points[~below], upper, count - count // 2)

    return Block(number - 1, np.stack(cut(points, np.array([[-ENDLESS] * 3, [ENDLESS] * 3]), count)))


def write_block(folder: Path, block: Block) -> None:
    """Note in the folder of a training that it has ended, and which block it was."""
    write_json(folder / BLOCK, {"number": block.number, "cells": block.cells.tolist()})


def _block_of_json(facts: dict) -> Block:
    cells = np.array(facts["cells"], np.float64).reshape(-1, 2, 3)
    return Block(whole_number(facts["number"], "block", len(cells) - 1), cells)


def holds_another(folder: Path) -> bool:
    """Whether there is a training in a folder, or a model that was not merged of the blocks there.

    Raises:
        InputError: if its cfg_args is damaged.
    """
    from warp_splat.formats.checkpoint import LAST  # noqa: PLC0415 - torch takes seconds to load

    options = read_cfg_args(folder) if (folder / "cfg_args").exists() else {}
    merged = options.get("blocks") and any(folder.glob(f"*/{BLOCK}"))
    return (folder / LAST).exists() or (any(folder.glob(AS_SAVED)) and not merged)


def merge_blocks(config: MergeConfig) -> int:
    """Make one model of trainings of all blocks, as ``config`` says; returns the process's exit code.

    Of each model, the Gaussians are taken whose means lie in its own cell.

    Raises:
        InputError: if a block has not been trained to its end, or is there twice; if one is of another cut or kind.
    """
    from warp_splat.formats.curve import arranged  # noqa: PLC0415 - torch takes seconds to load

    folder = Path(config.folder)
    places = sorted(path.parent for path in folder.glob(f"*/{BLOCK}"))
    if (another := holds_another(folder)) or not places:
        found = "another model" if another else "none" if folder.is_dir() else "no such folder"
        raise InputError(f"{folder}: expected only folders of ended trainings by --block, found {found}.")
    blocks = [read_json(place / BLOCK, "a block as training writes it", _block_of_json) for place in places]
    models = [open_model(place)[:2] for place in places]
    trained, kinds = [read_cfg_args(place) for place in places], []
    for place, block, options in zip(places, blocks, trained, strict=True):
        origin = (read_coordinates(place) or {}).get("origin")
        cells = {"number of blocks": len(block.cells), "cells": block.cells.tolist(), "origin": origin}
        kinds.append({**cells, **{name: options.get(name) for name in (*COMMON, "linear_light")}})
        if other := [name for name, value in kinds[-1].items() if value != kinds[0][name]]:
            raise InputError(f"{place}: expected the {other[0]} of {places[0]}, found another; move one of them away.")
    numbers, count = [block.number for block in blocks], len(blocks[0].cells)
    if wrong := [f"{numbers.count(n)} of block {n + 1}/{count}" for n in range(count) if numbers.count(n) != 1]:
        raise InputError(f"{folder}: expected one ended training of each block, found {', '.join(wrong)}.")
    path = ply_path(folder, max(iteration for iteration, _ in models))
    splats, clouds, cameras = [], [], {}
    for place, block, (_, file) in zip(places, blocks, models, strict=True):
        splats.append(file.splats.take(block.holds(file.splats.means)))
        cloud = load_points(place / "input.ply")
        own = block.holds(cloud[0])
        clouds.append([column[own] for column in cloud])
        named = lambda entries: {str(entry["img_name"]): entry for entry in entries}  # noqa: E731
        cameras |= read_json(place / CAMERAS, "cameras as training writes them", named)
    merged = models[0][1]._replace(splats=arranged(concatenated(splats)), linear=False)  # cfg_args says it
    save_points(folder / "input.ply", *map(np.concatenate, zip(*clouds, strict=True)))
    write_json(folder / CAMERAS, [{**cameras[name], "id": index} for index, name in enumerate(sorted(cameras))])
    write_coordinates(folder, read_coordinates(places[0]))
    for old in folder.glob(AS_SAVED):  # merged before
        old.unlink()
    write_cfg_args(folder, {**trained[0], "block": "", "blocks": count, "model_path": str(folder)})
    save_gaussians(path, merged)  # last: without the rest, they would be drawn otherwise
    print(f"{path}: {len(merged.splats.means)} Gaussians of {count} blocks")
    return 0
