"""Trained Gaussians in Newton's simulations (docs/simulation.md)."""

from warp_splat.newton.sensor import SensorSplatCamera, camera_of_fov, gaussian_of_file

__all__ = ["SensorSplatCamera", "camera_of_fov", "gaussian_of_file"]
