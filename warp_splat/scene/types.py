"""What a loaded scene is: cameras with their photographs, and what training starts from."""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from warp_splat.camera import Camera, mean_up
from warp_splat.color import to_srgb
from warp_splat.config import NEAR
from warp_splat.errors import InputError
from warp_splat.formats.coordinates import UP, read_coordinates
from warp_splat.formats.model_folder import CAMERAS, folder_of, read_cameras, trained_names
from warp_splat.formats.splats import SplatFile

if TYPE_CHECKING:
    from warp_splat.scene.blocks import Block

WALK = 5.0  # times as far away as what comes near: the largest extent
REFINED = 0.05  # of a scene's extent, and rad, together, by which a training moves and turns no camera
ASKED_FOR = 0.5  # likewise, with --parts pose
EVALUATED = 100  # views, at most, of those for training: hundreds more would take hours, and say the same


def visible(camera: Camera, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Which of ``points`` [P, 3] show inside the camera's image, [P] bool: of a pinhole, those in front of it.

    ``margin``: of its size, what counts as well at each side.
    """
    x, y, z = (camera.rotation[:, :, None] * points.T).sum(1) + camera.translation[:, None]
    if camera.lens:
        px, py = camera.pixels(np.stack([x, y, z], 1)).T  # NaN, and so outside, where the lens sees nothing
        z = np.ones_like(px)
    else:
        px, py = x * camera.fx + z * camera.cx, y * camera.fy + z * camera.cy  # times z
    across, down = margin * camera.width * z, margin * camera.height * z
    in_width = (px >= -across) & (px <= z * camera.width + across)
    return (z > 0) & in_width & (py >= -down) & (py <= z * camera.height + down)


def nearest_shown(cameras: list[Camera], points: np.ndarray, least: float = 0.0) -> float:
    """How near ``points`` [P, 3] come: the median over cameras of the distance of the nearest 1 % that each shows.

    What a wall hides does not count, since it is farther away, nor what is within ``least``. Of many, a hundred cameras
    and 20,000 points are asked. Infinity if no camera shows anything.
    """
    found, points = [], points[np.random.default_rng(0).permutation(len(points))[:20_000]]
    for camera in cameras[:: -(-len(cameras) // 100)]:
        distances = np.sqrt(((points[visible(camera, points)] - camera.center) ** 2).sum(1))
        distances = np.sort(distances[distances > least])
        found += distances[len(distances) // 100 :][:1].tolist()
    return float(np.median(found or [math.inf]))


def spread_of(centers: np.ndarray) -> float:
    """The largest distance of cameras' centers [C, 3] from their mean; 0 if all stand at one place."""
    largest = np.linalg.norm(centers - centers.mean(0), axis=1).max()
    return largest if largest >= 1e-6 * np.abs(centers).max() else 0.0


class Decoded(NamedTuple):
    """A photograph in memory."""

    image: np.ndarray  # [H, W, 3] on the background: uint8 as a screen shows it, or float32 in linear light
    alpha: np.ndarray | None = None  # [H, W] uint8, where the photograph says it; for other backgrounds
    mask: np.ndarray | None = None  # [H, W] uint8, 1 where the photograph counts; None: everywhere

    def read(self) -> "Decoded":
        """These."""
        return self

    @property
    def linear(self) -> bool:
        """Whether ``image`` is in linear light."""
        return self.image.dtype != np.uint8


class Stored(NamedTuple):
    """A photograph in its file, and what the file's header says."""

    read: Callable[[], Decoded]  # keeps what memory has room for
    linear: bool
    alpha: bool  # whether it may have one
    mask: bool


@dataclass(frozen=True, eq=False)
class View:
    """One photograph and the camera that took it."""

    name: str  # as in the scene's files, with sub-folder and extension
    camera: Camera  # scaled to `image`
    photograph: Decoded | Stored
    original: Camera  # before the resize of `-r` (after undistortion)
    undistorted: bool = False  # from the file, which a lens with distortion took

    @property
    def pixels(self) -> Decoded:
        """The photograph, decoded anew if it is stored and there was no room to keep it."""
        return self.photograph.read()

    @property
    def image(self) -> np.ndarray:
        """See :class:`Decoded`."""
        return self.pixels.image

    @property
    def alpha(self) -> np.ndarray | None:
        """See :class:`Decoded`; nothing is decoded where there can be none."""
        return self.pixels.alpha if self.photograph.alpha is not False else None

    @property
    def mask(self) -> np.ndarray | None:
        """See :class:`Decoded`; nothing is decoded where there is none."""
        return self.pixels.mask if self.photograph.mask is not False else None

    @property
    def linear(self) -> bool:
        """Whether ``image`` is in linear light."""
        return self.photograph.linear

    @property
    def picture(self) -> np.ndarray:
        """``image`` as a screen shows it, [H, W, 3] uint8."""
        return as_shown(self.image)


class Sightings(NamedTuple):
    """The points that structure from motion triangulated with a photograph, and where it saw them there."""

    ids: np.ndarray  # [M] int64, of the points: the same in every photograph
    points: np.ndarray  # [M, 3] float64, world coordinates
    slopes: np.ndarray  # [M, 2] float64, x / z and y / z in the camera, of the keypoints without the lens's distortion


def as_shown(image: np.ndarray) -> np.ndarray:
    """An image of :class:`Decoded` as a screen shows it, [H, W, 3] uint8."""
    return image if image.dtype == np.uint8 else np.rint(255 * to_srgb(image.clip(0, 1), np.where)).astype(np.uint8)


class PhotoMemory(NamedTuple):
    """Bytes of photographs."""

    limit: float = math.inf  # of those that training keeps, at the size of its steps
    later: float = 0.0  # that will be taken by what is not decoded yet


@dataclass(frozen=True, eq=False)
class Scene:
    """Views to train on, views held out, and the points to start from."""

    train: list[View]
    test: list[View]
    points: np.ndarray  # [P, 3] float32, world coordinates
    colors: np.ndarray  # [P, 3] uint8
    start: SplatFile | None = None  # Gaussians to start from instead; the points are their centers
    random_points: bool = False  # drawn, since there were none
    find_tracks: Callable[[], dict[str, Sightings]] = dict  # by the names of views
    source: Path | None = None  # its folder
    memory: PhotoMemory = field(default_factory=PhotoMemory)
    block: "Block | None" = None  # that it is, of a larger scene

    @cached_property
    def tracks(self) -> dict[str, Sightings]:
        """What each view saw of the points, by its name; empty if the scene does not say. Read when first asked for."""
        return self.find_tracks()

    @cached_property
    def coordinates(self) -> dict | None:
        """Where the scene is in the world (``formats/coordinates.py``), if it says so."""
        return read_coordinates(self.source) if self.source else None

    def refuse_other_frame(self, name: str | Path, coordinates: dict | None) -> None:
        """Raise InputError if Gaussians are not where the scene is, as their origin tells, or their cameras by name."""
        if coordinates and self.coordinates and coordinates["origin"] != self.coordinates["origin"]:
            raise InputError(
                f"{name}: expected Gaussians from the origin {self.coordinates['origin']} of {self.source}, found "
                f"{coordinates['origin']}; name the scene that they were trained on, or train anew."
            )
        ends = lambda camera: camera.center + self.extent * camera.rotation  # noqa: E731 - of its axes, [3, 3]
        here, off = {view.name: ends(view.camera) for view in (*self.train, *self.test)}, []
        refined = any(folder_of(name).glob(f"point_cloud/*/{CAMERAS}"))
        most = ASKED_FOR if refined else REFINED
        with suppress(InputError):  # another trainer's file may tell other things
            cameras = [(ends(camera), here[view]) for view, camera in read_cameras(folder_of(name)) if view in here]
            off = [np.linalg.norm(there - at, axis=1).max() for there, at in cameras]
        if off and (far := np.quantile(off, 0.75) / self.extent) > most:
            raise InputError(
                f"{name}: expected cameras as in {self.source}, found a quarter of them moved or turned by {far:.0%} "
                "of its size; name the scene that it was trained on, or a copy of its .ply (-m, --start_ply)."
            )

    def trained_among(self, path: str | Path) -> list[str]:
        """Photographs that are held out now, and on which the model at a path was trained: mostly none."""
        trained = trained_names(path)
        return [view.name for view in self.test if view.name in trained]

    @property
    def up(self) -> np.ndarray:
        """Away from the ground, [3], unit length: as coordinates say it, or the mean of the cameras."""
        return UP if self.coordinates else mean_up([view.camera for view in self.train])

    @property
    def linear(self) -> bool:
        """Whether the photographs, and so the Gaussians' colors, are in linear light."""
        return self.train[0].linear

    @property
    def evaluated(self) -> tuple[str, list[View]]:
        """The views to judge by, with their name: those held out; if none are, those for training, or EVALUATED."""
        return ("test", self.test) if self.test else ("train", self.train[:: -(-len(self.train) // EVALUATED)])

    @cached_property
    def extent(self) -> float:
        """1.1 x the largest distance of a training camera's center from their mean (the reference's getNerfppNorm).

        Where all cameras stand at one place that is 0, and nothing could learn: then 1.1 x the median distance of the
        points from there. A long walk is no large thing seen from far away: its extent is 1.1 x WALK x how near points
        come to its cameras, at most. Tried by the means' rate, 2,500 steps, one seed:

        - 1,000 photographs, whose spread is 20 times that: 23.9 dB with the spread, 25.15 with 5.2, 25.2 with 3.5, 25.1
          with 2.5, 24.8 with 0.5
        - 300, of 6 times: 28.5 dB with the spread, 28.4 with 2.3 or 1.1
        """
        cameras = [view.camera for view in self.train]
        centers = np.stack([camera.center for camera in cameras])
        spread = spread_of(centers) or np.median(np.linalg.norm(self.points - centers.mean(0), axis=1))
        near = math.inf if self.random_points else nearest_shown(cameras, self.points, NEAR)
        return float(1.1 * min(spread, WALK * near))
