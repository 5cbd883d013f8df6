"""A camera sensor for Newton's simulations: draws the Gaussian shapes of a model, placed by bodies, among its meshes.

The tape of Warp has all of it: :mod:`warp_splat.kernels.place` around :mod:`warp_splat.tape`.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial, partialmethod
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from warp_splat import tape
from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.errors import InputError, imported
from warp_splat.formats.exchange import load_gaussians
from warp_splat.formats.stored import sigmoid, unit_quats
from warp_splat.kernels.place import ShapeView, make_place, name_shapes, put_among_meshes
from warp_splat.raster.checks import check_background, check_options
from warp_splat.raster.worlds import takes
from warp_splat.runtime.launch import launch_on_tape, open_tape

AT_ONCE = 2**20  # Gaussians of views that are drawn together, or 16 times as many pixels
TOGETHER, PLACES = 32, 1024  # that are kept: of worlds that are drawn together, and of views
Seen = tuple[slice, dict[str, wp.array]]  # views, and their pixels by their names, on black
#: Of what images are.
KINDS = dict.fromkeys(("color_image", "shape_index_image", "mesh_color", "mesh_index"), wp.uint32)
KINDS |= {"rgb_image": wp.vec3, "forward_depth_image": wp.float32, "mesh_depth": wp.float32}


@dataclass(eq=False)
class Piece:
    """A Gaussian shape of a world."""

    shape: int
    body: int
    size: float
    source: Any  # newton.Gaussian
    view: ShapeView  # of it, in this size


def count_of(pieces: Sequence[Piece]) -> int:
    """How many Gaussians they have."""
    return sum(piece.source.count for piece in pieces)


class SensorSplatCamera:
    """Draws all Gaussian shapes of a Newton model: harmonics of all degrees, any number of hits, gradients.

    Shapes of a body follow it; those of no world are part of all, and held once. Whether they are VISIBLE does not
    matter: with ``is_visible=False``, Newton's own sensor leaves them to this one. Not thread-safe.

    Args:
        model: the ``newton.Model``.
        background: RGB behind everything.
        options: of the renderer; ``depth`` and ``strongest`` are set as images are asked for.
        adjoint: as in :func:`warp_splat.rasterize`.

    Raises:
        InputError: if the model has no Gaussian shape, or one with a scale that is not the same along all axes; for an
            option or a background that there is not.
    """

    def __init__(
        self,
        model: Any,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        options: RasterOptions | None = None,
        adjoint: str = "manual",
    ):
        if not isinstance(getattr(model, "shape_scale", None), wp.array):
            raise InputError(f"model: expected a newton.Model, as finalized, got {type(model).__name__}.")
        self.model, self.device, self.adjoint = model, model.device, adjoint
        self.background = wp.vec3(*check_background(background, torch.device("cpu")).tolist())
        self.options = check_options(adjoint, options)
        self._layout_of, self._owners_of = _kept(self._layout), _kept(self._find_owners)
        self._places_of = lru_cache(PLACES)(self._places)
        bodies, worlds = model.shape_body.numpy(), model.shape_world.numpy()
        sizes, view = model.shape_scale.numpy(), cache(self._view)
        self._pieces: dict[int, list[Piece]] = {world: [] for world in range(-1, max(model.world_count, 1))}
        for shape, source in enumerate(model.shape_source):
            if not hasattr(source, "sh_coeffs"):
                continue
            if not ((size := float(sizes[shape][0])) > 0 and np.allclose(sizes[shape], size)):
                raise InputError(f"shape {shape}: expected a scale that is positive and the same along all axes.")
            piece = Piece(shape, int(bodies[shape]), size, source, view(source, size))
            self._pieces[int(worlds[shape])].append(piece)
        if not any(self._pieces.values()):
            raise InputError("model: expected a Gaussian shape (ModelBuilder.add_shape_gaussian), found none.")

    def allocate_image(self, view_count: int, width: int, height: int, dtype: Any) -> wp.array:
        """An image for :meth:`update`; those below are of one kind, by Newton's names."""
        return wp.zeros((view_count, height, width), dtype=dtype, device=self.device)

    allocate_image_color = allocate_image_shape_index = partialmethod(allocate_image, dtype=wp.uint32)
    allocate_image_depth_forward = partialmethod(allocate_image, dtype=wp.float32)

    def update(
        self,
        state: Any,
        camera_transforms: wp.array[wp.transform] | wp.array2d[wp.transform],
        camera: Camera | Sequence[Camera],
        *,
        rgb_image: wp.array3d[wp.vec3] | wp.array4d[wp.vec3] | None = None,
        color_image: wp.array3d[wp.uint32] | wp.array4d[wp.uint32] | None = None,
        forward_depth_image: wp.array3d[wp.float32] | wp.array4d[wp.float32] | None = None,
        shape_index_image: wp.array3d[wp.uint32] | wp.array4d[wp.uint32] | None = None,
        mesh_color: wp.array3d[wp.uint32] | wp.array4d[wp.uint32] | None = None,
        mesh_depth: wp.array3d[wp.float32] | wp.array4d[wp.float32] | None = None,
        mesh_index: wp.array3d[wp.uint32] | wp.array4d[wp.uint32] | None = None,
        world_indices: wp.array[wp.int32] | Sequence[int] | None = None,
    ) -> None:
        """Draw; inside ``with wp.Tape()``, with gradients from ``rgb_image`` and ``forward_depth_image``.

        They go to ``state.body_q``, ``camera_transforms`` and ``model.shape_transform``, where those want them. Images
        are [views, H, W], as ``newton.sensors.SensorCamera``'s, and those of meshes may be written over. Or,
        as its tiled camera has them, transforms are [cameras, worlds] and images [worlds, cameras, H, W].

        Args:
            state: the ``newton.State``.
            camera_transforms: [views] transform, world from camera, which looks along -z with y up.
            camera: size and lens of all views, or of each, or of each of the tiled cameras; its pose does not count.
            rgb_image: vec3, colors as trained, displayed without a change.
            color_image: uint32, the same packed as Newton packs RGBA.
            forward_depth_image: float, expected depth along the axis, of a wide lens the distance; 0 where nothing is.
            shape_index_image: uint32, the shape of the Gaussian that is seen most, or the mesh, if more is seen of it
                than of all Gaussians; 0xFFFFFFFF where nothing is.
            mesh_color: uint32, ``color_image`` of Newton's sensor: what is seen through the Gaussians.
            mesh_depth: float, its ``forward_depth_image``, for a wide lens its ``depth_image``: hides Gaussians whose
                centers are farther.
            mesh_index: uint32, its ``shape_index_image``.
            world_indices: world of each view, which the host reads; by default view i is world i.

        Raises:
            InputError: if an image is of another shape, one of meshes has no depth, or options.hidden_from beside it, a
                view is of no world, or an argument is of another type.
        """
        given = {name: array for name, array in locals().items() if name in KINDS and array is not None}
        bodies = 0 if (placed := getattr(state, "body_q", None)) is None else len(placed)
        if bodies < self.model.body_count:
            raise InputError(f"state: expected one of the model's, of {self.model.body_count} bodies, got {bodies}.")
        if not isinstance(camera_transforms, wp.array) or camera_transforms.dtype is not wp.transform:
            found = f"{type(camera_transforms).__name__} of {getattr(camera_transforms, 'dtype', 'no dtype')}"
            raise InputError(f"camera_transforms: expected a Warp array of transforms, got {found}.")
        cameras = list(camera) if isinstance(camera, Sequence) else [camera] * len(camera_transforms)
        if others := [type(one).__name__ for one in cameras if not isinstance(one, Camera)]:
            raise InputError(f"camera: expected a warp_splat.Camera, or a list of them, got {others[0]}.")
        sizes = {(one.height, one.width) for one in cameras}
        if len(cameras) != (count := len(camera_transforms)) or len(sizes) != 1:
            raise InputError(f"camera: expected one, or {count} of one size, got {len(cameras)} of {len(sizes)} sizes.")
        shape = (*camera_transforms.shape[::-1], *sizes.pop())  # pyright: ignore[reportAttributeAccessIssue]
        for name, array in given.items():
            kind, is_array = KINDS[name], isinstance(array, wp.array)
            if not is_array or (array.shape, array.dtype) != (shape, kind):
                found = f"{array.shape} of {array.dtype.__name__}" if is_array else type(array).__name__
                raise InputError(f"{name}: expected {shape} of {kind.__name__}, got {found}.")
            if name in ("mesh_color", "mesh_index") and mesh_depth is None:
                raise InputError(f"{name}: expected mesh_depth beside it, which says where meshes are, got None.")
            if name == "mesh_depth" and self.options.hidden_from is not None:
                raise InputError("mesh_depth: expected none beside options.hidden_from, which hides, too; omit one.")
        if camera_transforms.ndim == 2:  # one camera after another
            for number, one in enumerate(cameras):
                column = {name: array[:, number] for name, array in given.items()}
                poses = camera_transforms[number]  # pyright: ignore[reportIndexIssue]
                self.update(state, poses, one, **column, world_indices=world_indices)
            return
        views, shape = shape[0], shape[1:]
        worlds = world_indices.numpy() if isinstance(world_indices, wp.array) else world_indices
        chosen = np.arange(views) if worlds is None else np.asarray(worlds)
        whole, count = chosen.shape == (views,) and chosen.dtype.kind in "iu", len(self._pieces) - 1
        if not whole or not all(0 <= world < count for world in chosen):
            raise InputError(f"world_indices: expected {views} of 0..{count - 1}, got {chosen.tolist()}.")
        asked = {"depth": forward_depth_image is not None, "strongest": int(shape_index_image is not None)}
        options, poseless = replace(self.options, **asked), {"rotation": np.eye(3), "translation": np.zeros(3)}
        lenses = {id(one): replace(one, **poseless) for one in cameras}
        cameras, place = [lenses[id(one)] for one in cameras], partial(self._place, state, camera_transforms)
        # a tape reads them again, when they may be written over
        color, depth = (wp.clone(a) if a and open_tape() else a for a in (mesh_color, mesh_depth))
        draw = self._draw_each
        if not open_tape() and options.hidden_from is None and all(takes(lens, options) for lens in lenses.values()):
            draw = partial(self._draw_together, camera_transforms)
        for views, seen in draw(place, cameras, chosen.tolist(), options, depth):
            surfaces, size = _part(depth, views), seen["alpha"].size
            if shape_index_image is not None:  # first, because the depth of meshes may be written over
                inputs = [seen["strongest"], seen["strongest_weights"], seen["alpha"]]
                inputs += [self._owners_of(*chosen[views].tolist()), surfaces, _part(mesh_index, views)]
                launch_on_tape(name_shapes, size, inputs, [_part(shape_index_image, views)], self.device)
            inputs = [seen["image"], seen["alpha"], seen.get("depth"), self.background]
            made = [_part(image, views) for image in (rgb_image, color_image, forward_depth_image)]
            inputs += [_part(color, views), surfaces]
            launch_on_tape(put_among_meshes, size, inputs, made, self.device)

    def _draw_each(self, place, cameras, worlds, options, mesh_depth) -> Iterator[Seen]:
        """One view after the other, with gradients on a tape."""
        for view, world in enumerate(worlds):
            given = place(view, [self._pieces[-1] + self._pieces[world]])
            more = {"adjoint": self.adjoint, "options": options, "hidden_from": _part(mesh_depth, view)}
            seen = vars(tape.rasterize(*given, cameras[view], **more))
            seen = {name: array for name, array in seen.items() if isinstance(array, wp.array) and array.ndim > 1}
            yield slice(view, view + 1), {name: array.reshape((1, *array.shape)) for name, array in seen.items()}

    def _draw_together(self, camera_transforms, place, cameras, worlds, options, mesh_depth) -> Iterator[Seen]:
        """Without gradients: views of one camera in a row at once; from one place, what is shared once."""
        shared, keys = self._pieces[-1], [(id(camera),) for camera in cameras]
        if shared and mesh_depth is None:
            eyes = [(*key, *pose) for key, pose in zip(keys, camera_transforms.numpy().tolist(), strict=True)]
            same = [before == eye for before, eye in pairwise([None, *eyes, None])]
            keys = [eye if same[view] or same[view + 1] else keys[view] for view, eye in enumerate(eyes)]
        for key, group in groupby(range(len(keys)), keys.__getitem__):
            first, *others = group
            camera, backdrop, end = cameras[first], None, first + 1 + len(others)
            if len(key) > 1:
                given = place(first, [shared])
                _, backdrop = tape.draw_worlds(*given, counts=[count_of(shared)], camera=camera, options=options)
            most = max(count_of(shared + self._pieces[world]) for world in worlds[first:end])
            size = max(AT_ONCE // max(most, camera.width * camera.height // 16, 1), 1)
            parts = [slice(begin, min(begin + size, end)) for begin in range(first, end, size)]
            while parts:
                part = parts.pop(0)
                table = [([] if backdrop else shared) + self._pieces[world] for world in worlds[part]]
                more = {"camera": camera, "options": options, "hidden_from": _part(mesh_depth, part)}
                given, counts = place(part.start, table), [count_of(pieces) for pieces in table]
                try:
                    yield part, tape.draw_worlds(*given, counts=counts, backdrop=backdrop, **more)[0]
                except InputError:  # one that cannot be drawn, or too many at once
                    if len(table) == 1:
                        raise
                    middle = (part.start + part.stop) // 2
                    parts = [slice(part.start, middle), slice(middle, part.stop), *parts]

    def _place(self, state, camera_transforms, first: int, table: Sequence[list[Piece]]) -> tuple[wp.array, ...]:
        """The Gaussians of pieces, view after view, in the camera's frame; on a tape, in arrays of their own."""
        sources = (tuple((piece.source, piece.size) for piece in pieces) for pieces in table)
        scales, opacities, *made = self._layout_of(*sources)
        if open_tape():
            made = [wp.empty_like(array, requires_grad=True) for array in made]
        for splats, where in self._places_of(first, *map(tuple, table)):
            count, coefficients = splats.sh.shape
            inputs = [where, splats, self.model.shape_transform, state.body_q, camera_transforms]
            launch_on_tape(make_place(coefficients), count * len(where), inputs, made, self.device)
        means, quats, sh = made
        return means, quats, scales, opacities, sh

    def _places(self, first: int, *table: tuple[Piece, ...]) -> list[tuple[ShapeView, wp.array]]:
        """The Gaussians of each source, and where they are placed; see :func:`make_place`."""
        begin, found = 0, {}
        for view, pieces in enumerate(table, first):
            for piece in pieces:
                _, where = found.setdefault(id(piece.view), (piece.view, []))
                where.append((view, piece.body, piece.shape, begin))
                begin += piece.source.count
        return [(splats, wp.array(where, dtype=wp.vec4i, device=self.device)) for splats, where in found.values()]

    def _view(self, source: Any, size: float) -> ShapeView:
        """The arrays of a ``newton.Gaussian``, whose coefficients are in the order of PLY files."""
        view, count = ShapeView(), source.count
        coefficients = next(k for k in (16, 9, 4, 1) if source.sh_coeffs.shape[1] >= 3 * k)
        rest = source.sh_coeffs[:, 3 : 3 * coefficients].reshape(count, 3, coefficients - 1).transpose(0, 2, 1)
        sh = np.concatenate([source.sh_coeffs[:, None, :3], rest], 1)
        view.means = wp.array(size * source.positions, dtype=wp.vec3, device=self.device)
        view.quats = wp.array(source.rotations, dtype=wp.quat, device=self.device)
        view.sh = wp.array(sh, dtype=wp.vec3, device=self.device)
        return view

    def _layout(self, *views: tuple[tuple[Any, float], ...]) -> tuple[wp.array, ...]:
        """Of the Gaussians of sources, each in its size, view after view: what they share in this order, and room.

        Their scales [N] and opacities [N]; for means, quats and colors in a camera's frame.
        """
        parts = [part for view in views for part in view]
        scales = np.concatenate([np.empty((0, 3)), *(size * source.scales for source, size in parts)])
        opacities = np.concatenate([np.empty(0), *(source.opacities for source, _ in parts)])
        scales = wp.array(scales, dtype=wp.vec3, device=self.device)
        new = partial(wp.empty, len(opacities), device=self.device)
        room = new(dtype=wp.vec3), new(dtype=wp.quat), new(dtype=wp.vec3).reshape((-1, 1))
        return scales, wp.array(opacities, dtype=float, device=self.device), *room

    def _find_owners(self, *worlds: int) -> wp.array:
        """The shape of each Gaussian of these worlds, [W, most]."""
        table = [self._pieces[-1] + self._pieces[world] for world in worlds]
        shapes = np.zeros((len(table), max(map(count_of, table))), dtype=np.uint32)
        for row, pieces in zip(shapes, table, strict=True):
            row[: count_of(pieces)] = np.repeat(*np.int64([(p.shape, p.source.count) for p in pieces]).reshape(-1, 2).T)
        return wp.array(shapes, dtype=wp.uint32, device=self.device)


def _kept(make: Callable[..., Any]) -> Callable[..., Any]:
    """``make`` of views, made once for each alone, and kept for some that are drawn together."""
    alone, together = cache(make), lru_cache(TOGETHER)(make)
    return lambda *views: (alone if len(views) == 1 else together)(*views)


def _part(array: wp.array | None, views: int | slice) -> Any:
    """Of some views, if there is one."""
    return None if array is None else array[views]


def camera_of_fov(width: int, height: int, camera_fov: float) -> Camera:
    """The pinhole of Newton's ``compute_camera_rays_pinhole``; ``camera_fov`` is vertical, in radians.

    Raises:
        InputError: if no pinhole sees so far.
    """
    if not 0.0 < camera_fov < math.pi:
        raise InputError(f"camera_fov: expected radians between 0 and pi, got {camera_fov}.")
    focal = 0.5 * height / math.tan(0.5 * camera_fov)
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, np.eye(3), np.zeros(3))


def gaussian_of_file(path: str | Path, **more: Any) -> Any:
    """A ``newton.Gaussian`` of a file of any of our formats, in the axes of its training: y down, z forward.

    ``more`` goes to its constructor. It knows no antialiasing: of a model that was trained so, give the sensor
    ``RasterOptions(antialiasing=True)``.

    Raises:
        InputError: if the file cannot be read or has no Gaussians, or the package newton is not installed.
    """
    newton = imported("newton", "newton: expected the package newton; `pip install 'newton>=1.8'`.")
    means, sh, opacities, scales, quats = load_gaussians(path).splats
    if not len(means):
        raise InputError(f"{path}: expected Gaussians, found none, and newton takes no shape without; name another.")
    coefficients = np.concatenate([sh[:, 0], sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1)], 1)
    rotations = unit_quats(quats)[:, [1, 2, 3, 0]]
    return newton.Gaussian(means, rotations, np.exp(scales), sigmoid(opacities), coefficients, **more)
