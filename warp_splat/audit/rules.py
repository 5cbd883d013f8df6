"""What a renderer does, found from pictures of probes: each rule as a sentence, and as options for the oracle."""

from collections.abc import Callable, Iterable

import numpy as np
import torch

from warp_splat.audit.probes import CENTER, GREEN, PROBE, PROBED, Prober, decoded_srgb, probe_camera, srgb
from warp_splat.audit.renderer import Answer, RendererFailed
from warp_splat.audit.small_scenes import balls
from warp_splat.compare import oracle
from warp_splat.compare.workloads import Workload
from warp_splat.formats.stored import SH_C0

OPAQUE = 0.9995  # what lets through more than most stops
ASKED = (0.25, 0.5, 0.75)  # a background
#: Projections, and what is said of them.
SHOWN_AS = {"affine": "linearized at their center", "ellipsoid": "seen as ellipsoids along rays"}


def find_background(prober: Prober) -> str:
    """What is behind everything, asked for light blue and for black."""
    arrays = balls(PROBE, [CENTER], 3.0, 3.0, 0.9, GREEN)
    asked, black = (prober.picture(arrays, background) for background in (ASKED, (0.0, 0.0, 0.0)))
    if not np.ptp(black, axis=(0, 1)).max() > 0:
        raise RendererFailed("shows nothing of a Gaussian in the middle, or numbers that are not finite")
    asked, black = asked[0, 0], black[0, 0]
    prober.behind, prober.background = black, tuple(np.round(black, 3).tolist())
    if min(np.abs(asked - each).max() for each in (ASKED, srgb(np.array(ASKED)))) < 0.01 and black.max() < 0.01:
        prober.background = ASKED
        return "The background asked for is blended behind the Gaussians."
    shown = {"black": 0.0, "white": 1.0}
    name = next((name for name, value in shown.items() if np.abs(asked - value).max() < 0.01), np.round(asked, 3))
    return f"The background asked for is ignored; it is {name}."


def find_color_space(prober: Prober) -> str:
    """Whether and where the curve of sRGB is applied."""
    colors = np.array([0.2, 0.45, 0.7])
    arrays = balls(PROBE, [CENTER], 3.0, 8.0, 0.7, colors)
    image, exact = prober.picture(arrays), prober.exact(arrays)
    alpha, plain = exact.alpha.numpy()[..., None], exact.image.numpy()
    light = decoded_srgb(colors) * alpha + (1 - alpha) * prober.behind
    candidates = {"as they are": plain, "encoded": srgb(plain), "decoded": light, "in linear light": srgb(light)}
    found = prober.nearest(image, candidates)
    prober.encoded, prober.decoded = found in ("encoded", "in linear light"), found in ("decoded", "in linear light")
    return {
        "as they are": "Colors are blended and shown as the file says.",
        "encoded": "The picture is encoded by the sRGB curve after blending: it comes out too bright.",
        "decoded": "Colors are decoded from sRGB before blending, and not encoded again: it comes out too dark.",
        "in linear light": "Colors are blended in linear light, and encoded by the sRGB curve after that.",
        "other": "Colors are neither as the file says nor changed by the sRGB curve.",
    }[found]


def find_low_pass(prober: Prober) -> str:
    """With the antialiasing: a ball of 0.5 px, its variance by the ratio of neighbors, its strength by its height."""
    cover = prober.cover([CENTER], 4.0, 0.5, 0.9)
    height, beside = cover[23, 31], np.mean([cover[23, 30], cover[23, 32], cover[22, 31], cover[24, 31]])
    if height <= prober.seen or beside <= prober.seen:
        return "Gaussians of half a pixel are not drawn, or have no width."
    if height <= beside:
        return "A Gaussian of half a pixel is as strong beside its pixel as in it: the low-pass filter was not found."
    variance = 0.5 / np.log(height / beside)
    blur, step = variance - 0.25, 4 * prober.seen / beside * variance
    name = prober.measured("blur", blur - step, blur + step)
    prober.options["blur"] = max(prober.options["blur"], 1e-6)
    share = height / 0.9
    wanted = 0.25 / variance
    antialiased = abs(share - wanted) < abs(share - 1)
    prober.options["antialiasing"] = bool(antialiased and blur > 0.02)
    if abs(share - (wanted if antialiased else 1)) > 0.05:
        prober.sentences["antialiasing"] = f"A Gaussian of half a pixel has {share:.2f} of its opacity."
    elif prober.options["antialiasing"]:
        prober.sentences["antialiasing"] = "Opacities are scaled by the share of area that the low-pass filter added."
    else:
        prober.sentences["antialiasing"] = "There is no antialiasing: small Gaussians grow brighter."
    return f"The low-pass filter adds {name} px² to the variances." if blur > 0.02 else "There is no low-pass filter."


def find_cut(prober: Prober) -> str:
    """With the extent: where stacks of faint balls end, once by alpha, once by standard deviations."""
    edges = []
    for opacity in (0.05, 0.02):
        cover = prober.cover([CENTER] * 32, np.linspace(3, 3.5, 32), 8.0, opacity)
        alpha = prober.alpha(8.0, opacity)
        drawn = cover > max(prober.seen, 1e-3 * alpha.max())
        gone = alpha[~drawn & (32 * alpha > 2 * max(prober.seen, 1e-3 * alpha.max()))]
        edges.append((gone.max(initial=0.0), alpha[drawn].min(initial=1.0)))
    (low, high), other = edges
    prober.options["alpha_min"] = 0.0
    if low == 0:
        return f"No alpha is left out, down to {max(high, prober.seen / 32):.1g}."
    if not 0.8 < other[0] / low < 1.25:  # not by alpha: see find_extent
        return f"No alpha is left out for being faint, down to {min(high, other[1]):.1g}."
    name = prober.measured("alpha_min", min(low, high), max(low, high))
    return f"An alpha below {name} is left out."


def find_extent(prober: Prober) -> str:
    """Where a strong Gaussian ends although its alpha is not faint yet."""
    alpha = prober.alpha(6.0, 0.95)
    deviations = np.sqrt(-2 * np.log(alpha / 0.95).clip(max=0))
    if not (drawn := prober.cover([CENTER], 3.0, 6.0, 0.95) > 0.3 * alpha).any():
        return "A Gaussian of 6 px is not drawn."
    missing = ~drawn & (alpha > 1.1 * max(prober.options.get("alpha_min", 0), 1.5 * prober.seen, 1e-6))
    if not missing.any():
        return "A Gaussian reaches as far as its alpha does."
    first, last = deviations[missing].min(), deviations[drawn].max()
    shape = "round" if last - first < 0.25 else f"not round: some pixels up to {last:.1f} are drawn"
    return f"A Gaussian ends {first:.1f} standard deviations from its center ({shape}), where alpha is still " \
           f"{alpha[missing].max():.1g}."  # fmt: skip


def find_clamp(prober: Prober) -> str:
    """The largest alpha."""
    top = prober.cover([CENTER], 3.0, 9.0, OPAQUE)[23, 31]
    if top > OPAQUE - 2 * (step := max(prober.seen, 2e-6)):
        prober.options["alpha_max"] = 0.9999
        return f"Alpha is not clamped below {OPAQUE - 2 * step:.4g}."
    name = prober.measured("alpha_max", top - step, min(top + step, 1))
    return f"Alpha is clamped at {name}."


def find_stop(prober: Prober) -> str:
    """What is left of the light behind many faint layers, where blending in 8 bits stops, or fewer strong ones."""
    layers = ((160, 0.1), (20, 0.6))
    left = 1 - max(prober.cover([CENTER] * n, np.linspace(3, 5, n), 9.0, opacity)[23, 31] for n, opacity in layers)
    if left < max(2 * prober.seen, 2e-7):
        prober.options["t_min"] = 0.0 if prober.seen < 1e-6 else oracle.STOP
        return f"A pixel does not stop while its transmittance is above {max(left, prober.seen):.1g}."
    name = prober.measured("t_min", 0.9 * left, left)
    return f"A pixel stops where its transmittance would fall below {name}."


def find_near(prober: Prober) -> str:
    """Which of nine depths are drawn."""
    depths = np.array([0.002, 0.007, 0.015, 0.05, 0.07, 0.15, 0.3, 0.7, 1.5])
    pixels = np.stack([np.linspace(4.5, 60.5, 9), np.full(9, 24.5)], 1)
    drawn = prober.cover(pixels, depths, 1.5, 0.9)[24, pixels[:, 0].astype(int)] > 0.3
    if drawn.all():
        prober.options["near"] = 1e-6
        return f"There is no near plane, down to {depths[0]}."
    if not drawn.any():
        return "Nothing nearer than 1.5 is drawn."
    low, high = depths[~drawn].max(), depths[drawn].min()
    name = prober.measured("near", low, high)
    return f"Gaussians nearer than about {name} are left out (between {low:g} and {high:g})."


def find_rotation(prober: Prober) -> str:
    """In which order the numbers of a rotation are read."""
    color = np.array([0.9, 0.6, 0.3])
    arrays = balls(PROBE, [CENTER], 3.0, 5.0, 0.8, color) | {"scales": np.array([[0.6, 0.15, 0.05]])}
    quat = np.array([0.8, 0.1, 0.3, 0.5]) / np.linalg.norm([0.8, 0.1, 0.3, 0.5])
    image = prober.picture(arrays | {"quats": quat[None]})
    arrays |= {"sh_dc": (prober.blended(color)[None, None] - 0.5) / SH_C0}
    orders = {"w, x, y, z": quat, "x, y, z, w": quat[[3, 0, 1, 2]], "w, x, y, z, inverse": quat * [1, -1, -1, -1]}
    candidates = {name: prober.exact(arrays | {"quats": order[None]}).image.numpy() for name, order in orders.items()}
    found = prober.nearest(image, candidates)
    known = f"Rotations are read as {found}."
    return "A needle does not look as in any known order of a rotation's numbers." if found == "other" else known


def find_harmonics(prober: Prober) -> str:
    """Each coefficient above degree 0 in a Gaussian of its own, seen from a direction where none is zero."""
    if prober.degree == 0:
        return "It claims no harmonics above degree 0."
    count = (prober.degree + 1) ** 2
    camera = probe_camera(seed=5, center=(0.0, 0.0, 0.0))
    places = np.stack(np.meshgrid(np.arange(4) * 14 + 11.5, np.arange(4) * 11 + 7.5), -1).reshape(-1, 2)[:count]
    arrays = balls(camera, places, np.linspace(3, 4, count), 1.5, 0.9, 0.5)
    rest = np.zeros((count, count - 1, 3))
    rest[np.arange(1, count), np.arange(count - 1)] = 0.8
    image = prober.picture(arrays | {"sh_rest": rest}, camera=camera)
    blank = prober.picture(arrays | {"sh_rest": 0 * rest}, camera=camera)
    rows, columns = places[:, 1].astype(int), places[:, 0].astype(int)
    basis = oracle.sh_basis(torch.tensor(arrays["means"] / np.linalg.norm(arrays["means"], axis=1)[:, None]), 3).numpy()
    span = prober.blended(0.5) - prober.behind
    alpha = np.maximum((blank - prober.behind)[rows, columns] / span, 0.1)
    color = prober.behind + (image - prober.behind)[rows, columns] / alpha
    found = ((srgb(color) if prober.decoded else color).mean(1) - 0.5) / 0.8
    wrong = []
    for k in range(1, count):
        if abs(found[k] - basis[k, k]) < 0.02:
            continue
        near = {sign * j: abs(found[k] - sign * basis[k, j]) for j in range(1, count) for sign in (1, -1)}
        best = -k if near[-k] < 0.02 else min(near, key=near.__getitem__)
        what = "has the other sign" if best == -k else f"is taken for {'-' * (best < 0)}{abs(best)}"
        wrong.append(f"{k} {'is not seen' if abs(found[k]) < 0.004 else what if near[best] < 0.02 else 'is another'}")
    if wrong:
        return f"Harmonics differ: coefficient {'; '.join(wrong)}."
    return f"Harmonics up to degree {prober.degree} have the usual signs and order."


def find_sort(prober: Prober) -> str:
    """What decides which of two Gaussians is in front."""

    def front(first, second, camera) -> int:
        """Which of two is in front, 0 or 1; -1: neither."""
        given = arrays | {"sh_dc": (prober.blended(colors)[:, None] - 0.5) / SH_C0}
        one, two = (prober.exact({k: a[[i]] for k, a in given.items()}, camera, oracle.BLACK) for i in (first, second))
        image = prober.picture({name: array[[first, second]] for name, array in arrays.items()}, camera=camera)
        over = lambda a, b: (a.image + (1 - a.alpha[..., None]) * b.image).numpy()  # noqa: E731
        left = ((1 - one.alpha) * (1 - two.alpha))[..., None].numpy() * prober.behind
        found = prober.nearest(image, {"0": over(one, two) + left, "1": over(two, one) + left})
        return -1 if found == "other" else int(found)

    colors = np.array([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9]])
    arrays = balls(PROBE, [CENTER, CENTER], [3.0, 4.0], 8.0, 0.7, colors)
    both = front(0, 1, PROBE), front(1, 0, PROBE)
    if both != (0, 1):
        return {
            (0, 0): "Gaussians are not sorted: the first in the file is in front.",
            (1, 1): "Gaussians are not sorted: the last in the file is in front.",
            (1, 0): "The order is reversed: the farther Gaussian is in front.",
        }.get(both, "Two Gaussians behind each other do not look as in either order.")
    wide = probe_camera(30.0)
    arrays = balls(wide, [[56.5, 30.5], [24.5, 19.5]], [3.0, 3.3], [14.0, 16.0], 0.7, colors)
    arrays["scales"] = arrays["scales"] * [1.0, 1.0, 0.1]  # balls as large would reach behind the camera
    keys = {(0, 1): "depth along the axis", (1, 0): "distance from the camera"}
    key = keys.get((front(0, 1, wide), front(1, 0, wide)), "depth, and by neither the axis nor the distance alone")
    return f"Gaussians are sorted by {key}."


def find_pixels(prober: Prober) -> str:
    """Where three small Gaussians are seen: from where float64 has them, linearized or as ellipsoids."""
    places, y, x = np.array([[12.5, 10.25], [33.0, 24.75], [52.25, 38.5]]), *np.mgrid[: PROBED[1], : PROBED[0]] + 0.5

    def centers(cover: np.ndarray) -> np.ndarray:
        shares = [cover * (np.maximum(*np.abs([x - int(a) - 0.5, y - int(b) - 0.5])) < 9) for a, b in places]
        return np.array([[(share * x).sum() / share.sum(), (share * y).sum() / share.sum()] for share in shares])

    arrays = balls(PROBE, places, [3.0, 3.5, 4.0], 2.0, 0.9, GREEN)
    seen = centers(prober.cover_of(arrays).clip(0))
    offsets = {how: seen - centers(prober.exact(arrays, projection=how).alpha.numpy()) for how in SHOWN_AS}
    how = min(offsets, key=lambda how: np.ptp(offsets[how], axis=0).max())
    shift, spread = offsets[how].mean(0), np.abs(offsets[how]).max()
    limit = 0.01 if prober.seen < 1e-6 else 0.05
    prober.shift = shift if spread > limit else prober.shift
    prober.options["projection"] = how
    where = f"off by up to {spread:.2g} px, on average by ({shift[0]:.2f}, {shift[1]:.2f})"
    where = f"as asked within {spread:.1g} px: centers of pixels are at +0.5" if spread < limit else where
    return f"Gaussians are {SHOWN_AS[how]}; places are {where}."


#: In an order in which later ones may use what earlier ones found.
FINDERS = {
    "background": find_background,
    "camera": find_pixels,
    "color space": find_color_space,
    "low-pass": find_low_pass,
    "cut": find_cut,
    "extent": find_extent,
    "clamp": find_clamp,
    "stop": find_stop,
    "near plane": find_near,
    "rotation": find_rotation,
    "harmonics": find_harmonics,
    "order": find_sort,
}


def find_rules(draw: Callable[[Workload], Answer], degree: int = 3, names: Iterable[str] = tuple(FINDERS)) -> Prober:
    """The rules of a renderer: ``sentences`` by name, ``options`` for the oracle."""
    prober = Prober(draw, degree)
    for name in names:
        try:
            prober.sentences[name] = FINDERS[name](prober)
        except RendererFailed as error:
            prober.sentences[name] = f"Not found: it {error}."
            if name == "background":  # the first, and nothing is seen: it would be the same for the others
                break
    return prober
