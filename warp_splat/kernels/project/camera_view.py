"""The camera as kernels read it."""

import warp as wp

from warp_splat.kernels.simd import fill, vec16


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


@wp.func
def turn(camera: CameraView, row: int, column: int, like: float):
    """An entry of the camera's rotation, without a gradient, which would take a quarter of the adjoint."""
    return fill(camera.rotation[row, column], like)


@wp.func
def turn(camera: CameraView, row: int, column: int, like: vec16):
    return fill(camera.rotation[row, column], like)


@wp.func_grad(turn)
def adj_turn(camera: CameraView, row: int, column: int, like: float, adj_ret: float):
    pass


@wp.func_grad(turn)
def adj_turn(camera: CameraView, row: int, column: int, like: vec16, adj_ret: vec16):
    pass


@wp.func
def of_lens(camera: CameraView, index: int, like: float):
    """A number of the camera's lens, likewise."""
    return fill(camera.lens[index], like)


@wp.func
def of_lens(camera: CameraView, index: int, like: vec16):
    return fill(camera.lens[index], like)


@wp.func_grad(of_lens)
def adj_of_lens(camera: CameraView, index: int, like: float, adj_ret: float):
    pass


@wp.func_grad(of_lens)
def adj_of_lens(camera: CameraView, index: int, like: vec16, adj_ret: vec16):
    pass
