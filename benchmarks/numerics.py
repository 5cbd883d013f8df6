"""What a gradient owes to rounding, to the cuts, and to decisions at their thresholds.

Walks: a pixel of random alphas through which a thousandth of the light comes, forward and back in float32, against the
same in float64; the bounds are those of docs/adjoints.md. Trained scenes: float64 without and with a cut, and how often
float32 decides otherwise at 1/255; gradients summed in random orders, as atomic additions are. Integrators: the
observed order, from docs/compare/volume.csv.

    python benchmarks/numerics.py [-s SCENE -m MODEL ...] [--out docs/benchmarks]
"""

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from common import ROOT, load_model, option, parse, write_table

from warp_splat.camera import Camera
from warp_splat.compare import oracle
from warp_splat.compare.stability.verdict import EPS
from warp_splat.config import ALPHA_MIN, RasterOptions
from warp_splat.raster.data import Gaussians
from warp_splat.raster.project import project
from warp_splat.runtime import launch
from warp_splat.scene import load_scene

#: Of scenes and their models, for :func:`views_of`.
PAIRS = (
    option("-s", "--scenes", nargs="*", default=[], action="extend"),
    option("-m", "--models", nargs="*", default=[], action="extend", help="one for each scene"),
)
LAYERS, PIXELS = (10, 100, 1_000, 10_000, 100_000), 256
LEFT = 1e-3  # of the light, behind all layers
SIDE, ORDERS = 48, 20  # pixels of a square whose gradients are summed, in that many orders
NEAR = 0.05  # of 1/255, relative: pairs that tell how many of them are where rounding decides
HEADERS = ("what", "where", "measured", "along the exact one", "by the square root", "bound", "condition")


def single(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


def forward(alphas: np.ndarray, rounded) -> np.ndarray:
    """Transmittances in front of each layer, and behind the last, [n + 1, P]."""
    t = [np.ones(alphas.shape[1])]
    for alpha in alphas:
        t.append(rounded(t[-1] - alpha * t[-1]))  # fused: one rounding
    return np.array(t)


def backward(alphas: np.ndarray, light: np.ndarray, last: np.ndarray, rounded) -> tuple[np.ndarray, np.ndarray]:
    """T in front of each layer, recovered, and dL/dalpha, [n, P]; ``light``: color times upstream gradient."""
    t, behind, ts, grads = last, np.zeros_like(last), [], []
    for alpha, own in zip(alphas[::-1], light[::-1], strict=True):
        odds = rounded(alpha / rounded(1.0 - alpha))
        t = rounded(t + t * odds)
        grads.append(rounded(t * own - rounded(behind * odds + behind)))
        behind = rounded(rounded(alpha * t) * own + behind)
        ts.append(t)
    return np.array(ts[::-1]), np.array(grads[::-1])


def walk(count: int) -> list[dict]:
    """A pixel of ``count`` layers: the transmittance, and the gradients by which pass is rounded."""
    generator = np.random.default_rng(count)
    alphas = generator.uniform(0.0, 2.0, (count, PIXELS)) * -np.log(LEFT) / count
    alphas = single(np.minimum(alphas, 0.99))
    light = single(generator.uniform(-1.0, 1.0, (count, PIXELS)))
    exact = lambda values: values  # noqa: E731
    truth = forward(alphas, exact)
    _, grads = backward(alphas, light, truth[-1], exact)
    last = forward(alphas, single)[-1]
    found, both = backward(alphas, light, last, single)
    of_adjoint = backward(alphas, light, truth[-1], single)[1]
    of_forward = backward(alphas, light, last, exact)[1]

    # roundings of T in front of layer k: n of the forward pass, then 1 and two of the odds, which count alpha times
    own = 1.0 + 2.0 * alphas
    roundings = count + np.cumsum(own[::-1], 0)[::-1]
    squares = np.sqrt(count + np.cumsum((1.0 + 2.0 * alphas**2)[::-1], 0)[::-1])
    weights = np.abs(alphas * truth[:-1] * light)
    after = (np.cumsum(weights[::-1], 0)[::-1] - weights) / (1.0 - alphas)
    here = np.abs(truth[:-1] * light)
    left = count - np.arange(count)[:, None]
    bounds = [
        EPS * (here * (counts + 2.0) + after * (counts + more + 4.0))
        for counts, more in ((roundings, left), (squares, np.sqrt(left)))
    ]
    size = np.linalg.norm(grads)
    where, condition = f"{count} layers", np.linalg.norm(here + after) / size
    recovered = np.abs(found / truth[:-1] - 1.0).max()
    rows = [{"what": "T, worst layer", "where": where, "measured": recovered}]
    rows[0] |= {"root": 3.0 * EPS * squares.max(), "bound": EPS * roundings.max(), "condition": 1.0}
    for name, got in (("forward pass alone", of_forward), ("adjoint alone", of_adjoint), ("both", both)):
        row = {"what": f"gradient, rounded: {name}", "where": where, "measured": np.linalg.norm(got - grads) / size}
        root, bound = (np.linalg.norm(some) / size for some in bounds[::-1])
        rows.append(row | ({"root": root, "bound": bound, "condition": condition} if name == "both" else {}))
    return rows


def views_of(arguments: argparse.Namespace) -> Iterator[tuple[str, Gaussians, Camera]]:
    """Each scene's name, its model's Gaussians, and its first camera, shrunk to --width."""
    for folder, model in zip(arguments.scenes, arguments.models, strict=True):
        scene = load_scene(folder, resolution=arguments.width, eval=True, report=str)
        with torch.no_grad():
            gaussians = load_model(model).arranged().activated()
        yield Path(folder).name, gaussians, scene.train[0].camera


def some_pixels(camera: Camera, count: int, generator: torch.Generator) -> torch.Tensor:
    """Row and column of each, [P, 2], at random."""
    sides = (camera.height, camera.width)
    return torch.stack([torch.randint(0, side, (count,), generator=generator) for side in sides], 1)


def sorted_splats(gaussians: Gaussians, camera: Camera) -> tuple[oracle.Splats, torch.Tensor]:
    """Projected in float64, and those that are seen, nearest first."""
    double = [tensor.double() for tensor in gaussians]
    exact = oracle.exact_splats(*double[:4], torch.cat(double[4:], 1), camera)
    order = torch.sort(exact.z.float(), stable=True).indices
    return exact, order[exact.live[order]]


def biased(name: str, gaussians: Gaussians, camera: Camera, count: int) -> list[dict]:
    """How far gradients with a cut are from those without, float64, of random signs at some pixels."""
    generator = torch.Generator().manual_seed(1)
    pixels = some_pixels(camera, count, generator)
    signs = 2.0 * torch.randint(0, 2, (count, 3), generator=generator).double() - 1.0
    found, rows = {}, []
    for cuts in ((0.0, 0.0), (ALPHA_MIN, 0.0), (0.0, 1e-4)):
        double = [tensor.detach().double() for tensor in gaussians]
        leaves = [tensor.requires_grad_() for tensor in (*double[:4], torch.cat(double[4:], 1))]
        for part, sign in zip(pixels.split(8), signs.split(8), strict=True):
            image = oracle.exact_render(*leaves, camera, alpha_min=cuts[0], t_min=cuts[1], pixels=part).image
            (image * sign).sum().backward()
        found[cuts] = [leaf.grad for leaf in leaves]
    for cuts, what in (((ALPHA_MIN, 0.0), "the cut at 1/255"), ((0.0, 1e-4), "the stop at 1e-4")):
        for place, of in ((0, "means"), (2, "scales"), (3, "opacities"), (4, "harmonics")):
            exact, cut = found[0.0, 0.0][place], found[cuts][place]
            along = float((cut * exact).sum() / exact.square().sum())
            row = {"what": f"gradient of {of} by {what}", "where": name}
            rows.append(row | {"measured": float((cut - exact).norm() / exact.norm()), "along": along})
    return rows


@torch.no_grad()
def flipped(name: str, gaussians: Gaussians, camera: Camera, count: int) -> list[dict]:
    """How often float32 decides otherwise than float64 whether alpha is below 1/255, and what that changes."""
    pixels = some_pixels(camera, count, torch.Generator().manual_seed(2))
    exact, order = sorted_splats(gaussians, camera)
    drawn = project(gaussians, camera, RasterOptions(alpha_min=1e-6))
    xx, xy, yy = drawn.conics[order].unbind(1)
    colors = exact.color[order]
    flips = expected = near = off = change = most = 0.0
    for part in pixels.split(64):
        raw, _ = oracle._alphas(exact, order, camera, part)
        dx, dy = (drawn.means2d[order] - (part.flip(1) + 0.5)[:, None]).unbind(2)
        alphas = drawn.opacities[order] * torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
        alphas = torch.where(drawn.radii[order] > 0, alphas.double(), raw)
        solid = torch.where(raw < ALPHA_MIN, 0.0, raw.clamp_max(0.99))
        front = torch.cumprod(1.0 - solid, 1) / (1.0 - solid)
        close = ((raw / ALPHA_MIN).log().abs() < NEAR) & (front > 1e-4)
        offs = (alphas / raw).log().abs()[close].clamp_max(NEAR)
        other = ((raw < ALPHA_MIN) != (alphas < ALPHA_MIN)) & close
        flips, near, off = flips + float(other.sum()), near + float(close.sum()), off + float(offs.sum())
        expected += float(offs.sum()) / (2.0 * NEAR)  # as likely anywhere within NEAR
        pixel, layer = close.nonzero(as_tuple=True)
        light = torch.cumsum((front * solid)[..., None] * colors, 1)
        behind = light[pixel, -1] - light[pixel, layer]
        own = front[close, None] * colors[layer]
        change += float((offs * (behind - own).abs().amax(1)).sum())
        most += float((offs * front[close]).sum() * colors.max())
    per = 1e6 / count
    return [
        {"what": "decisions at 1/255 that float32 turns, a megapixel: found", "where": name, "measured": per * flips},
        {"what": "the same, expected", "where": name, "measured": per * expected},
        {"what": "error of alpha there, relative, mean", "where": name, "measured": off / near},
        {
            "what": "what one changes in its pixel, mean",
            "where": name,
            "measured": ALPHA_MIN * change / off,
            "bound": ALPHA_MIN * most / off,
        },
    ]


@torch.no_grad()
def shuffled(name: str, gaussians: Gaussians, camera: Camera) -> list[dict]:
    """Gradients of opacities of random signs at SIDE x SIDE pixels, summed in float32 in random orders and in ours."""
    exact, order = sorted_splats(gaussians, camera)
    colors = exact.color[order]
    top, left = ((size // 2 - SIDE // 2) // 16 * 16 for size in (camera.height, camera.width))
    generator, terms = torch.Generator().manual_seed(3), []
    for pixel in range(0, SIDE * SIDE, 64):  # tile by tile, block by block, as the blend goes
        lanes = pixel + torch.arange(64)
        tile, block, lane = lanes // 256, lanes // 16 % 16, lanes % 16
        y = top + tile // (SIDE // 16) * 16 + block // 4 * 4 + lane // 4
        x = left + tile % (SIDE // 16) * 16 + block % 4 * 4 + lane % 4
        raw, _ = oracle._alphas(exact, order, camera, torch.stack([y, x], 1))
        solid = torch.where(raw < ALPHA_MIN, 0.0, raw.clamp_max(0.99))
        front = torch.cumprod(1.0 - solid, 1) / (1.0 - solid)
        light = (2.0 * torch.randint(0, 2, (64, 3), generator=generator).double() - 1.0) @ colors.T
        weighted = front * solid * light
        behind = weighted.sum(1, keepdim=True) - torch.cumsum(weighted, 1)
        by_alpha = front * light - behind / (1.0 - solid)
        terms.append((by_alpha * raw / exact.opacity[order] * (solid > 0.0)).float())
    each = torch.cat(terms).numpy()
    each = each[:, (each != 0.0).any(0)]
    truth, sizes = each.sum(0, dtype=np.float64), np.abs(each).sum(0, dtype=np.float64)
    length, generator = np.linalg.norm(truth), np.random.default_rng(4)
    found = [np.add.accumulate(each[generator.permutation(len(each))], 0)[-1] for _ in range(ORDERS)]
    ours = each.reshape(-1, 16, 16, each.shape[1])  # tiles, blocks, lanes
    for _ in range(3):
        ours = np.add.accumulate(ours, 1)[:, -1] if ours.ndim > 2 else np.add.accumulate(ours, 0)[-1]
    errors = [np.linalg.norm(one - truth) / length for one in found]
    apart = [np.linalg.norm(one - other) / length for one, other in zip(found[::2], found[1::2], strict=True)]
    counts, condition = (each != 0.0).sum(0), np.linalg.norm(sizes) / length
    bounds = [np.linalg.norm(EPS * by * sizes) / length for by in (np.sqrt(counts), counts)]
    rows = [
        {"measured": float(np.median(errors)), "root": bounds[0], "bound": bounds[1], "condition": condition},
        {"measured": float(np.median(apart))},
        {"measured": float(np.linalg.norm(ours - truth) / length)},
    ]
    names = ("gradient summed in random orders", "two such sums apart", "summed in the fixed order")
    return [{"what": what, "where": name} | row for what, row in zip(names, rows, strict=True)]


def orders() -> list[dict]:
    """By how much errors fall with twice the samples, at an optical depth of 1, between errors of 1e-1 and 1e-9."""
    errors: dict = {}
    with (ROOT / "docs/compare/volume.csv").open() as file:
        for row in csv.DictReader(file):
            if row["table"] == "integrators" and float(row["optical_depth"]) == 1.0:
                errors.setdefault(row["method"], {})[int(row["samples"])] = float(row["error"])
    rows = []
    for method, found in errors.items():
        pairs = [(found[n], found[2 * n]) for n in sorted(found) if 2 * n in found]
        steps = [np.log2(a / b) for a, b in pairs if 1e-1 > a > b > 1e-9]
        rows.append({"what": "order of the integrator", "where": method, "measured": float(np.median(steps[-3:]))})
    return rows


def main() -> None:
    arguments = parse(
        __doc__,
        *PAIRS,
        option("--width", type=int, default=240, help="of the view [px]"),
        option("--pixels", type=int, default=480),
    )
    launch.prepare("cpu", 0)
    rows = [row for count in LAYERS for row in walk(count)]
    for name, gaussians, camera in views_of(arguments):
        rows += flipped(name, gaussians, camera, arguments.pixels) + shuffled(name, gaussians, camera)
        rows += biased(name, gaussians, camera, arguments.pixels // 24)
    rows += orders()
    formats = {"measured": ".2g", "along": ".3f", "root": ".2g", "bound": ".2g", "condition": ".2g"}
    shown = [
        (row["what"], row["where"], *(format(row[key], how) if key in row else "" for key, how in formats.items()))
        for row in rows
    ]
    note = "Gradients: relative L2. The square root: of the number of roundings, three of them for the worst T."
    write_table("numerics", arguments.out, HEADERS, shown, note, {"rows": rows})


if __name__ == "__main__":
    main()
