"""Pictures of probes, and what can be read off them.

Everything is read off the cover of a green Gaussian, 1 - T, which any color behind it allows, or off which of several
candidates in float64 is nearest to the picture.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from warp_splat.audit.renderer import Answer
from warp_splat.audit.small_scenes import balls, on_all_pixels
from warp_splat.camera import Camera
from warp_splat.color import from_srgb, to_srgb
from warp_splat.compare import oracle
from warp_splat.compare.scenes import make_camera, tensors
from warp_splat.compare.workloads import Workload

GREEN, FOCAL = np.array([0.0, 1.0, 0.0]), 60.0
PROBED, CENTER = (63, 47), np.array([31.5, 23.5])  # px, the middle of a pixel and of the picture
SEEN = {True: 0.6 / 255, False: 1e-9}  # of a cover, by whether pictures have 8 bits
#: Gaussians far beside the picture, before and behind the camera: some viewers draw nothing of a scene that has
#: only one or two, or draw the last of their own order wrongly.
COMPANY = np.arange(16)
NEARLY_ROUND = np.array([0.999, 1.001, 1.0])  # of scales: some viewers do not draw what is round to the last bit
#: Values that renderers are known to have; a measured interval that holds one is named by it.
KNOWN = {"1/255": 1 / 255, "1/512": 1 / 512}
KNOWN |= {f"{value:g}": value for value in (1e-3, 1e-4, 1e-5, 1e-6, 0.01, 0.1, 0.2, 0.3, 0.99, 0.999)}


def probe_camera(focal: float = FOCAL, seed: int | None = None, **pose) -> Camera:
    """On whose axis CENTER lies; at the origin, unless a seed turns it."""
    return make_camera(*PROBED, focal, seed=seed, **pose)


PROBE = probe_camera()


def srgb(linear: np.ndarray) -> np.ndarray:
    """Encoded for a screen."""
    return to_srgb(np.clip(linear, 0, 1), np.where)


def decoded_srgb(shown: np.ndarray) -> np.ndarray:
    """The inverse of :func:`srgb`."""
    return from_srgb(np.clip(shown, 0, 1), np.where)


@dataclass
class Prober:
    """Draws probes and gathers what they say."""

    draw: Callable[[Workload], Answer]
    degree: int = 3
    sentences: dict[str, str] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)  # of the oracle, where they differ from the defaults
    behind: np.ndarray = field(default_factory=lambda: np.zeros(3))
    background: tuple[float, ...] = (0.0, 0.0, 0.0)  # what it can be asked for, or shows
    shift: np.ndarray = field(default_factory=lambda: np.zeros(2))  # px, of all places
    encoded: bool = False  # the picture
    decoded: bool = False  # colors, before they are blended
    seen: float = SEEN[False]

    def picture(self, arrays: dict[str, np.ndarray], background=(0.0, 0.0, 0.0), camera: Camera = PROBE) -> np.ndarray:
        """[H, W, 3] in the space in which it was blended."""
        ring = CENTER + 4 * FOCAL * np.stack([np.cos(COMPANY), np.sin(COMPANY)], 1)
        company = balls(camera, ring, np.where(COMPANY % 2, 25.0, -25.0), 0.1, 0.01, 0.5)
        company["sh_rest"] = np.zeros((len(COMPANY), *arrays["sh_rest"].shape[1:]))
        both = {name: np.concatenate([array, company[name]]) for name, array in arrays.items()}
        both["scales"] = both["scales"] * NEARLY_ROUND
        answer = self.draw(on_all_pixels("probe", (tensors(both), camera), background, self.degree))
        self.seen = SEEN[answer.eight_bit]
        return decoded_srgb(answer.image) if self.encoded else answer.image

    def cover(self, pixels, depth, sigma, opacity) -> np.ndarray:
        """1 - T of green balls, [H, W]."""
        return self.cover_of(balls(PROBE, np.asarray(pixels) - self.shift, depth, sigma, opacity, GREEN))

    def cover_of(self, arrays: dict[str, np.ndarray]) -> np.ndarray:
        """1 - T of what is green, [H, W]."""
        span = GREEN - self.behind
        return (self.picture(arrays) - self.behind) @ span / (span @ span)

    def blended(self, colors) -> np.ndarray:
        """What is blended of colors of the file."""
        return decoded_srgb(np.asarray(colors)) if self.decoded else np.asarray(colors)

    def exact(self, arrays: dict[str, np.ndarray], camera: Camera = PROBE, background=None, **view) -> oracle.Render:
        """What float64 says of a probe, at the places where the renderer draws it."""
        moved = replace(camera, cx=camera.cx + self.shift[0], cy=camera.cy + self.shift[1])
        arrays = arrays | {"scales": arrays["scales"] * NEARLY_ROUND}
        given = {name: torch.tensor(np.ascontiguousarray(array)) for name, array in arrays.items()}
        sh = torch.cat([given.pop("sh_dc"), given.pop("sh_rest")], 1)
        behind = tuple(self.behind if background is None else background)
        view = {"projection": self.options.get("projection", "affine")} | view
        return oracle.exact_render(**given, sh=sh, camera=moved, background=behind, **view)

    def alpha(self, sigma: float, opacity: float) -> np.ndarray:
        """Of a ball in the middle, [H, W], without thresholds."""
        thresholds = {"alpha_min": 0.0, "alpha_max": 1.0, "t_min": 0.0, "blur": self.options.get("blur", oracle.BLUR)}
        return self.exact(balls(PROBE, [CENTER - self.shift], 3.0, sigma, opacity, GREEN), **thresholds).alpha.numpy()

    def measured(self, option: str, low: float, high: float) -> str:
        """Sets an option to the middle of an interval, or to a known value that the interval holds; its name."""
        known = [name for name, value in KNOWN.items() if low * 0.999 <= value <= high * 1.001]
        self.options[option] = KNOWN[known[0]] if known else 0.5 * (low + high)
        return known[0] if known else f"{self.options[option]:.3g}"

    def nearest(self, image: np.ndarray, candidates: dict[str, np.ndarray]) -> str:
        """The name of the candidate nearest to the picture; "other" if none is near."""
        errors = {name: float(np.abs(image - each).mean()) for name, each in candidates.items()}
        best, second = sorted(errors, key=errors.__getitem__)[:2]
        return best if errors[best] < 0.5 * errors[second] else "other"
