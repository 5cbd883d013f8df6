"""The camera as kernels read it."""

import warp as wp

from warp_splat.kernels.simd import LANES, vec16


@wp.struct
class CameraView:
    """What the kernels need of a camera and its options."""

    rotation: wp.mat33  # camera_from_world
    center: wp.vec3  # world
    center_low: wp.vec3  # what float32 cut off the center: far from the origin, all of the accuracy
    focal: wp.vec2  # px
    principal: wp.vec2  # px
    size: wp.vec2  # px, (W, H)
    slope_min: wp.vec2  # clamp of (x/z, y/z) in the Jacobian
    slope_max: wp.vec2
    sh_degree: int
    antialiasing: int
    alpha_min: float
    near: float  # world units
    blur: float  # px^2
    lens: vec16  # coefficients of its formula; last, how far from the axis it is followed (:mod:`.lens`)


@wp.func_native("return camera.rotation.data[row][column];")
def turn(camera: CameraView, row: int, column: int, like: float) -> float:
    """An entry of the camera's rotation, without a gradient, which would take a quarter of the adjoint."""
    return camera.rotation[row, column]


@wp.func_native(f"return wp::vec_t<{LANES}, float>(camera.rotation.data[row][column]);")
def turn(camera: CameraView, row: int, column: int, like: vec16) -> vec16: ...


@wp.func_native("return camera.lens[index];")
def of_lens(camera: CameraView, index: int, like: float) -> float:
    """A number of the camera's lens, likewise."""
    return camera.lens[index]


@wp.func_native(f"return wp::vec_t<{LANES}, float>(camera.lens[index]);")
def of_lens(camera: CameraView, index: int, like: vec16) -> vec16: ...
