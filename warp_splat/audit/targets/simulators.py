"""A simulator written in Warp, whose camera traces rays through the Gaussians, without harmonics."""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

FLIP = np.diag([1.0, -1.0, -1.0])  # our axes of a camera and OpenGL's


def _pose(camera) -> Rotation:
    return Rotation.from_matrix(camera.rotation.T @ FLIP)


def newton(means, quats, scales, opacities, sh, camera, background):
    """Newton's ``SensorCamera``, its linear picture encoded for a screen by the sRGB curve, as its docs say."""
    import newton as simulator  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
    from newton.sensors import SensorCamera  # noqa: PLC0415  # pyright: ignore[reportMissingImports]

    builder = simulator.ModelBuilder()
    given = (means, quats[:, [1, 2, 3, 0]] / quats.norm(dim=1, keepdim=True), scales, opacities, sh[:, 0])
    arrays = [tensor.detach().numpy() for tensor in given]
    builder.add_shape_gaussian(-1, gaussian=simulator.Gaussian(*arrays))
    model = builder.finalize(device="cpu")
    sensor = SensorCamera(model)
    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    rays = SensorCamera.compute_camera_rays_pinhole_opencv(*lens, device="cpu")
    pose = wp.array([wp.transform(wp.vec3(*camera.center), wp.quat(*_pose(camera).as_quat()))], dtype=wp.transformf)
    out = sensor.allocate_image_color_hdr(1, camera.width, camera.height)
    sensor.update(model.state(), pose, rays, hdr_color_image=out)
    linear = out.numpy()[0].clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
