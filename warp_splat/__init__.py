"""3D Gaussian Splatting in NVIDIA Warp: train, render and differentiate, with or without an NVIDIA GPU.

Names are loaded when first used, so that ``warp-splat --help`` does not wait for torch and Warp.
"""

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOMES = {
    "Camera": "camera",
    "CameraParameters": "raster.camera_parameters",
    "Falloff": "kernels.falloff",
    "InputError": "errors",
    "Lens": "lenses",
    "RasterOptions": "config",
    "RenderOutput": "raster.api",
    "Shutter": "lenses.shutter",
    "check_gradients": "raster.gradcheck",
    "get_threads": "runtime.pool",
    "load_scene": "scene",
    "rasterize": "raster.api",
    "rasterize_views": "raster.api",
    "set_threads": "runtime.pool",
}
__all__ = list(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]

if TYPE_CHECKING:
    from warp_splat.camera import Camera as Camera
    from warp_splat.config import RasterOptions as RasterOptions
    from warp_splat.errors import InputError as InputError
    from warp_splat.kernels.falloff import Falloff as Falloff
    from warp_splat.lenses import Lens as Lens
    from warp_splat.lenses.shutter import Shutter as Shutter
    from warp_splat.raster.api import RenderOutput as RenderOutput
    from warp_splat.raster.api import rasterize as rasterize
    from warp_splat.raster.api import rasterize_views as rasterize_views
    from warp_splat.raster.camera_parameters import CameraParameters as CameraParameters
    from warp_splat.raster.gradcheck import check_gradients as check_gradients
    from warp_splat.runtime.pool import get_threads as get_threads
    from warp_splat.runtime.pool import set_threads as set_threads
    from warp_splat.scene import load_scene as load_scene


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'warp_splat' has no attribute {name!r}")
    return getattr(importlib.import_module(f"warp_splat.{_HOMES[name]}"), name)
