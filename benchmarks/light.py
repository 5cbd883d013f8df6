"""Light through the real 3D Gaussians, in float64 NumPy, and the steps from there to splatting.

Along a viewing ray, s units of length from the camera, Gaussians emit and absorb (Max 1995, "Optical models for direct
volume rendering"):

    dC/ds = tau C - g                                  C(far) = background; C(0) is what the camera sees
    C(0)  = int_0^inf g(s) exp(-int_0^s tau) ds + background exp(-int_0^inf tau)
    tau   = sum_i tau_i,  g = sum_i tau_i color_i,  tau_i = density_i exp(-(x - mean_i)' Sigma_i^-1 (x - mean_i) / 2)

On a ray each tau_i is a 1D Gaussian of s, so the inner integral, the optical depth, is a sum of erfs. The equation is
integrated from the far end to the camera, the way the light goes: there it decays, and is stiff where tau ds is large.

Splatting (Zwicker et al. 2001, "EWA volume splatting"; Kerbl et al. 2023) takes four shortcuts, which
:func:`splat_ladder` takes one at a time: Gaussians do not overlap along a ray, 1 - exp(-depth) is linear, footprints
are 2D Gaussians, and those are blurred a little.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from exact_cameras import exact_splats
from scipy.spatial.transform import Rotation
from scipy.special import erf, exprel

from warp_splat.camera import Camera
from warp_splat.compare import oracle
from warp_splat.errors import InputError
from warp_splat.formats.stored import SH_C0

REACH = 9.0  # standard deviations beyond which a Gaussian is nothing: exp(-81 / 2) = 3e-18
NODES = 16  # of Gauss and Legendre, in each panel of the truth

#: Extinction [..., rays] and source [..., rays, 3] at positions s on the rays; what the integrators know of a medium.
Medium = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Volume:
    """Emitting and absorbing Gaussians, float64.

    Args:
        means: centers, [N, 3], world units.
        quats: rotations wxyz of any norm but zero, [N, 4].
        scales: standard deviations, [N, 3], world units, positive.
        densities: extinction at the centers, [N], 1 / world unit, not negative.
        colors: [N, 3], the radiance of an opaque Gaussian.
        background: radiance that enters at the far end, [3].

    Raises:
        InputError: if a shape or a range is not as above.
    """

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    densities: np.ndarray
    colors: np.ndarray
    background: np.ndarray

    def __post_init__(self):
        count = len(self.means)
        shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3), (3,))
        for name, shape in zip(self.__dataclass_fields__, shapes, strict=True):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"Volume {name}: expected finite numbers of shape {shape}, got shape {value.shape}.")
            object.__setattr__(self, name, value)
        if (self.scales <= 0).any() or (self.densities < 0).any() or not self.quats.any(axis=1).all():
            raise InputError("Volume: expected positive scales, densities of 0 or more, and no quaternion of norm 0.")

    def splats(self, opacities: np.ndarray) -> list[torch.Tensor]:
        """Means, quaternions, scales, ``opacities`` [N] and harmonics, as a renderer takes them; float64."""
        arrays = [self.means, self.quats, self.scales, opacities, ((self.colors - 0.5) / SH_C0)[:, None]]
        return [torch.from_numpy(np.ascontiguousarray(array)) for array in arrays]


@dataclass(frozen=True, eq=False)
class Profile:
    """Gaussians on rays: ``peak * exp(-((s - center) / width)^2 / 2)``, each [rays, N]."""

    center: np.ndarray  # s, world units
    width: np.ndarray  # standard deviation, world units
    peak: np.ndarray  # 1 / world unit

    def extinction(self, s: np.ndarray) -> np.ndarray:
        """tau_i [..., rays, N] at positions ``s``, [..., rays] or [..., 1]."""
        return self.peak * np.exp(-0.5 * ((s[..., None] - self.center) / self.width) ** 2)

    def depths(self, s: np.ndarray | float = np.inf) -> np.ndarray:
        """Optical depth of each Gaussian from the camera to ``s`` [..., rays]: [..., rays, N]; by default of all."""
        scale = np.sqrt(0.5) / self.width
        ends = erf((np.asarray(s)[..., None] - self.center) * scale) - erf(-self.center * scale)
        return self.peak * self.width * np.sqrt(np.pi / 2) * ends

    def medium(self, colors: np.ndarray) -> Medium:
        """What an integrator samples; it takes positions [steps], the same on all rays."""

        def sample(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            each = self.extinction(s[:, None])
            return each.sum(-1), each @ colors

        return sample


def ray_profile(volume: Volume, origin: np.ndarray, directions: np.ndarray) -> Profile:
    """Each Gaussian as a function of the distance along each ray.

    In the frame where a Gaussian is the unit ball, a ray is a line m + s d: closest to the center at s = -m.d / |d|^2,
    |m x d| / |d| from it. Nothing is inverted but the scales, so needles lose no digits.

    Args:
        volume: N Gaussians.
        origin: where the rays start, [3] or [rays, 3].
        directions: unit vectors, [rays, 3].
    """
    whiten = Rotation.from_quat(volume.quats, scalar_first=True).as_matrix() / volume.scales[:, None, :]
    start = np.einsum("...nj,njk->...nk", np.atleast_2d(origin)[:, None] - volume.means, whiten)
    step = np.einsum("rj,njk->rnk", directions, whiten)
    square = (step**2).sum(-1)
    miss = (np.cross(start, step) ** 2).sum(-1) / square
    return Profile(-(start * step).sum(-1) / square, 1 / np.sqrt(square), volume.densities * np.exp(-0.5 * miss))


def integrate_exact(profile: Profile, colors: np.ndarray, background: np.ndarray, panels: int = 64) -> np.ndarray:
    """The truth: C(0) [rays, 3] by Gauss-Legendre panels over the integral, its optical depths exact (erf).

    The integrand is smooth, so the rule converges faster than any power once panels resolve the narrowest feature.
    """
    reach = REACH * profile.width
    seen = profile.peak > 0
    near = np.where(seen, profile.center - reach, np.inf).min(-1, initial=np.inf).clip(min=0)
    far = np.where(seen, profile.center + reach, 0).max(-1, initial=0)
    near = np.minimum(near, far)
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    half = 0.5 * (far - near) / panels
    radiance = np.exp(-profile.depths().sum(-1))[:, None] * background
    for panel in range(panels):
        s = near + half * (2 * panel + 1 + nodes[:, None])
        arriving = half * weights[:, None] * np.exp(-profile.depths(s).sum(-1))
        radiance = radiance + (arriving[..., None] * (profile.extinction(s) @ colors)).sum(0)
    return radiance


def integrate_exponential(medium: Medium, near: float, far: float, steps: int, background: np.ndarray) -> np.ndarray:
    """C(0) [rays, 3], taking tau and color for constant in each step: exact then, stable always, of order 2.

    One evaluation of the medium in the middle of each of the ``steps`` between ``near`` and ``far``.
    """
    ds = (far - near) / steps
    tau, source = medium(near + ds * (np.arange(steps) + 0.5))
    light = source * (ds * exprel(-tau * ds))[..., None]  # source / tau * (1 - exp(-tau ds)), also where tau is 0
    return _march(np.exp(-tau * ds), light, background)


def integrate_euler(medium: Medium, near: float, far: float, steps: int, background: np.ndarray) -> np.ndarray:
    """C(0) [rays, 3] by explicit Euler steps: of order 1, stable while tau ds < 2; may return inf or nan beyond.

    One evaluation of the medium at the far end of each step, where the step starts.
    """
    ds = (far - near) / steps
    tau, source = medium(near + ds * np.arange(1, steps + 1))
    return _march(1 - tau * ds, source * ds, background)


def integrate_rk4(medium: Medium, near: float, far: float, steps: int, background: np.ndarray) -> np.ndarray:
    """C(0) [rays, 3] by the classical Runge-Kutta method: of order 4, stable while tau ds < 2.785; else inf or nan.

    Two evaluations of the medium in each step, its ends being shared: 2 steps + 1 in all.
    """
    ds = (far - near) / steps
    tau, source = medium(np.linspace(near, far, 2 * steps + 1))
    parts = slice(2, None, 2), slice(1, None, 2), slice(None, -1, 2)  # far end, middle, near end of each step
    tau, source = [tau[part] for part in parts], [source[part] for part in parts]
    # The equation is linear, so that a step is too: what becomes of 1 without a source, and of 0 with it, says all.
    keep = _runge_kutta_step(1.0, tau, [0.0, 0.0, 0.0], ds)
    light = _runge_kutta_step(0.0, [value[..., None] for value in tau], source, ds)
    return _march(keep, light, background)


def _runge_kutta_step(radiance, tau, source, ds):
    """One step of dC/dq = g - tau C toward the camera, q = -s."""
    k1 = source[0] - tau[0] * radiance
    k2 = source[1] - tau[1] * (radiance + 0.5 * ds * k1)
    k3 = source[1] - tau[1] * (radiance + 0.5 * ds * k2)
    k4 = source[2] - tau[2] * (radiance + ds * k3)
    return radiance + ds / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def _march(keep: np.ndarray, light: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Steps C <- keep C + light from the far end (last) to the camera; ``keep`` [steps, rays], ``light`` [..., 3]."""
    radiance = np.broadcast_to(background, light.shape[1:])
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable method says so by its result
        for factor, added in zip(keep[::-1, :, None], light[::-1], strict=True):
            radiance = factor * radiance + added
    return radiance


def pixel_centers(camera: Camera) -> np.ndarray:
    """Of every pixel, [H * W, 2] px, row by row."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([x.ravel(), y.ravel()], 1)


def camera_rays(camera: Camera) -> np.ndarray:
    """Unit directions in the world through the pixel centers, [H * W, 3]; NaN where a lens sees nothing."""
    return camera.rays(pixel_centers(camera)) @ camera.rotation


def render_volume(volume: Volume, camera: Camera, panels: int = 64) -> np.ndarray:
    """The true image [H, W, 3], each pixel the radiance along the ray through its center."""
    profile = ray_profile(volume, camera.center, camera_rays(camera))
    image = integrate_exact(profile, volume.colors, volume.background, panels)
    return image.reshape(camera.height, camera.width, 3)


def peak_depths(volume: Volume, camera: Camera) -> np.ndarray:
    """Optical depth [N] of each Gaussian along the ray through its own center."""
    toward = volume.means - camera.center
    profile = ray_profile(volume, camera.center, toward / np.linalg.norm(toward, axis=1, keepdims=True))
    return np.diagonal(profile.depths())


def splat_ladder(volume: Volume, camera: Camera) -> dict[str, np.ndarray]:
    """Images [H, W, 3] of splatting's shortcuts; all Gaussians must lie in front of the camera.

    ============= ============================================================================================
    no overlap    each Gaussian's exact alpha, 1 - exp(-depth along the ray), composited in order of depth
    linear depth  that, but alpha = depth, at most 0.99 (the Taylor term: equal optical depth)
    linear peak   that, but alpha = o depth / peak depth with o = 1 - exp(-peak depth) (equal peak alpha)
    affine        no overlap, but depth = peak depth times the 2D Gaussian that EWA projects
    ellipsoid     no overlap, but depth = peak depth times the 2D Gaussian with the exact outline
    affine + blur affine, and the low-pass filter's 0.3 px^2
    3DGS          the renderer, its defaults, opacity o: linear peak, affine + blur, skip below 1/255, early stop
    ============= ============================================================================================
    """
    peak = peak_depths(volume, camera)
    exact, opacities = ray_profile(volume, camera.center, camera_rays(camera)).depths(), -np.expm1(-peak)
    linear = {"linear depth": exact, "linear peak": opacities * exact / np.where(peak > 0, peak, 1)}
    footprints = {"affine": ("affine", 0.0), "ellipsoid": ("ellipsoid", 0.0), "affine + blur": ("affine", oracle.BLUR)}
    images = splat_images(volume, camera, footprints)
    order = np.argsort(volume.means @ camera.forward, kind="stable")
    for name, alpha in linear.items():
        images[name] = composite(np.minimum(alpha, oracle.ALPHA_MAX)[:, order], volume, order, camera)
    scene, background = volume.splats(opacities), torch.from_numpy(volume.background)
    images["3DGS"] = oracle.exact_render(*scene, camera, background=background).image.numpy()
    return images


def splat_images(volume: Volume, camera: Camera, footprints: Mapping[str, tuple[str, float]]) -> dict[str, np.ndarray]:
    """Images [H, W, 3] of "no overlap", and of the same with footprints: a projection, and its blur [px^2].

    NaN where a lens has no ray. What a projection does not draw is nowhere.
    """
    peak, rays, scene = peak_depths(volume, camera), camera_rays(camera), volume.splats(np.ones(len(volume.means)))
    blind = np.isnan(rays[:, :1])
    found = {way: exact_splats(*scene, camera, projection=way[0], blur=way[1]) for way in footprints.values()}
    first = next(iter(found.values()))
    order = np.argsort(first.z.numpy(), kind="stable")
    exact = ray_profile(volume, camera.center, np.where(blind, camera.forward, rays)).depths() * first.live.numpy()
    depths = {"no overlap": exact} | {name: peak * falloff_at(found[way], camera) for name, way in footprints.items()}
    images = {name: composite(-np.expm1(-depth)[:, order], volume, order, camera) for name, depth in depths.items()}
    hidden = blind.reshape(camera.height, camera.width, 1)
    return {name: np.where(hidden, np.nan, image) for name, image in images.items()}


def falloff_at(splats: oracle.Splats, camera: Camera) -> np.ndarray:
    """exp(-d' cov2d^-1 d / 2) at each pixel, [H * W, N]."""
    offset, sharp = pixel_centers(camera)[:, None] - splats.means2d.numpy(), np.linalg.inv(splats.cov2d.numpy())
    around = camera.lens is not None and camera.lens.family.around
    falloff = 0.0
    for shift in (0, camera.width, -camera.width) if around else (0,):  # a panorama's copies
        moved = offset + np.array([shift, 0])
        falloff = falloff + np.exp(-0.5 * np.einsum("pni,nij,pnj->pn", moved, sharp, moved))
    return falloff * splats.live.numpy()


def composite(alpha: np.ndarray, volume: Volume, order: np.ndarray, camera: Camera) -> np.ndarray:
    """Front to back, ``alpha`` [H * W, N] being in ``order``."""
    through = np.cumprod(np.concatenate([np.ones_like(alpha[:, :1]), 1 - alpha], 1), axis=1)
    image = (through[:, :-1] * alpha) @ volume.colors[order] + through[:, -1:] * volume.background
    return image.reshape(camera.height, camera.width, 3)
