"""What a frame shows: colors, depth or opacity, and a photograph over them."""

import numpy as np
import torch
from PIL import Image

from warp_splat.color import to_bytes
from warp_splat.config import NEAR
from warp_splat.raster.api import RenderOutput
from warp_splat.viewer.browser_camera import Box

KINDS = ("image", "depth", "alpha")
DEPTH_SHARES = (0.02, 0.98)  # of the pixels; what is nearer or farther has the color of the ends
SAMPLES = 20_000  # pixels from which these are taken


def paint(out: RenderOutput, kind: str, linear: bool = False) -> tuple[np.ndarray, str]:
    """One of KINDS as [H, W, 3] uint8, and the range of the depths in words; ``linear``: colors are in linear light."""
    if kind == "alpha":
        return to_bytes(out.alpha[..., None].expand(-1, -1, 3)), ""
    if kind == "depth":
        near, far = depth_range(out.depth, out.alpha)
        return to_bytes(depth_colors(out.depth, out.alpha, near, far)), f"depth {near:.3g} (red) to {far:.3g} (blue)"
    return to_bytes(out.image, linear), ""


def depth_range(depth: torch.Tensor, alpha: torch.Tensor) -> tuple[float, float]:
    """Nearest and farthest depth that get colors of their own; those of DEPTH_SHARES of the pixels.

    Args:
        depth: [H, W] world units.
        alpha: [H, W]; pixels that are mostly empty do not count.
    """
    step = max(1, depth.numel() // SAMPLES)
    if not len(seen := depth.flatten()[::step][alpha.flatten()[::step] > 0.5]):
        return NEAR, 1.0
    low, high = torch.quantile(seen, torch.tensor(DEPTH_SHARES, device=depth.device)).tolist()
    return max(low, NEAR), max(high, NEAR, low * (1 + 1e-3))


def depth_colors(depth: torch.Tensor, alpha: torch.Tensor, near: float, far: float) -> torch.Tensor:
    """Depths as colors, [H, W, 3] in 0..1: red is near, blue is far, even steps in 1 / depth; black where it is empty.

    Args:
        depth: [H, W] world units.
        alpha: [H, W].
        near: depth of the first color, positive.
        far: of the last, positive.
    """
    import matplotlib  # noqa: PLC0415 - takes a while, and most look at the image

    farthest, reach = 1.0 / far, max(1.0 / near - 1.0 / far, 1e-6)
    place = ((1.0 / depth.clamp_min(NEAR) - farthest) / reach).clamp(0.0, 1.0)
    turbo = matplotlib.colormaps["turbo"](np.arange(256))[:, :3]  # of Mikhailov 2019, from blue to red
    table = torch.from_numpy(turbo.astype(np.float32)).to(depth.device)
    return table[(place * (len(table) - 1)).round().long()] * alpha[..., None]


def overlay(frame: np.ndarray, photograph: np.ndarray, box: Box, opacity: float) -> np.ndarray:
    """``frame`` [H, W, 3] uint8 with ``photograph`` [h, w, 3] uint8, scaled to ``box``, over it.

    Args:
        frame: the picture below.
        photograph: any size.
        box: where it lies; inside of the frame.
        opacity: of the photograph, 0..1.
    """
    result = frame.copy()
    inside = result[box]
    scaled = Image.fromarray(photograph).resize(inside.shape[1::-1], Image.Resampling.BILINEAR)
    inside[:] = Image.blend(Image.fromarray(inside), scaled, opacity)
    return result
