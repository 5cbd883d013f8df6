"""Newton, a simulator in Warp, whose camera traces rays through Gaussians without harmonics."""

import functools

import newton as simulator
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from scipy.spatial.transform import Rotation

from warp_splat.audit.probes import srgb

FLIP = np.diag([1.0, -1.0, -1.0])  # our axes of a camera and OpenGL's


def pose_of(camera) -> np.ndarray:
    """The rotation of OpenGL's camera, x y z w."""
    return Rotation.from_matrix(camera.rotation.T @ FLIP).as_quat()


def _newton(means, quats, scales, opacities, sh, camera, background, min_response, **settings):
    """Newton's ``SensorCamera``: its picture is linear, and encoded here for a screen."""
    builder = simulator.ModelBuilder()
    given = (means, quats[:, [1, 2, 3, 0]] / quats.norm(dim=1, keepdim=True), scales, opacities, sh[:, 0])
    arrays = [tensor.detach().numpy() for tensor in given]
    builder.add_shape_gaussian(-1, gaussian=simulator.Gaussian(*arrays, min_response=min_response))
    model = builder.finalize(device="cpu")
    sensor = SensorCamera(model, default_render_config=SensorCamera.RenderConfig(**settings))
    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    rays = SensorCamera.compute_camera_rays_pinhole_opencv(*lens, device="cpu")
    pose = wp.array([wp.transform(wp.vec3(*camera.center), wp.quat(*pose_of(camera)))], dtype=wp.transformf)
    out = sensor.allocate_image_color_hdr(1, camera.width, camera.height)
    sensor.update(model.state(), pose, rays, hdr_color_image=out)
    return srgb(out.numpy()[0])


newton = functools.partial(_newton, min_response=0.1)


def newton_blended(*given):
    """As far from a disk as its settings allow."""
    quality = {"gaussians_mode": SensorCamera.GaussianRenderMode.QUALITY, "gaussians_min_transmittance": 1.0}
    return _newton(*given, min_response=1 / 255, **quality)
