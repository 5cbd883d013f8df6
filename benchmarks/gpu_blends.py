"""For ``gpu.py``: the two blends alone, their share of what the card can do, and slots against atomics.

Slots: each tile instance has a row of its own, ``gather`` sums a Gaussian's rows in order. Atomics: the same
kernel adds into the Gaussian's row at once; no rows per instance, no second kernel, another sum in every run.
"""

import copy
import functools
import inspect

import torch
import warp as wp
from common import milliseconds
from made_up import cameras

from warp_splat.camera import Camera
from warp_splat.config import RasterOptions
from warp_splat.gaussians import GaussianModel
from warp_splat.kernels.cuda import adjoint
from warp_splat.kernels.inline import defined
from warp_splat.kernels.splat import BlendVariant
from warp_splat.raster.data import Gaussians, Pixels, alphas_of, variant_of
from warp_splat.raster.drivers import CUDA, THREADS
from warp_splat.raster.project import project
from warp_splat.runtime.launch import launch, launch_blocks

#: Floating-point operations for one Gaussian at one pixel (operators of splat.py, falloff.py and step.py).
#: Forward: offset 2, exponent 7, exponential 14, alpha 3, transmittance and weight 6, color 6, stop 1.
#: Adjoint: lit 7, offset 2, exponent 7, exponential 14, alpha 4, odds 2, transmittance 2, dL/dalpha 9, moments 5,
#: channels 4, and an addition for each of the ten sums over the block.
FORWARD, ADJOINT = 39, 66
SPLAT, INSTANCE, ROW = 48, 4, 36  # bytes; a place takes as many as an instance
ROUNDS, UNROLLED, CHAINS = 1024, 16, 4  # of multiply-adds; on sm_90 the compiler makes 64 FFMA of a round

SHARE_HEADERS = ("kernel", "ms", "GB", "% of the card's copy", "G operations", "% of its multiply-adds")
ATOMIC_HEADERS = (
    *("size", "Gaussians", "instances", "rows", "upstream ms", "adjoint ms", "gather ms", "sum ms"),
    "two runs alike",
)
LONGEST_HEADERS = ("scene", "tiles", "instances of a tile", "of the longest", "adjoint ms", "longest alone ms", "share")


@wp.kernel(enable_backward=False)
def multiply_add(first: int, rounds: int, factor: float, values_out: wp.array[wp.vec4]):
    i = first + wp.tid()
    x = values_out[i]
    a = x[0]
    b = x[1]
    c = x[2]
    d = x[3]
    for _round in range(rounds):
        for _k in range(UNROLLED):
            a = a * factor + 1.0
            b = b * factor + 1.0
            c = c * factor + 1.0
            d = d * factor + 1.0
    values_out[i] = wp.vec4(a, b, c, d)


@functools.cache
def make_adding_block(variant: BlendVariant) -> wp.Kernel:
    """The package's adjoint with another last line: what it wrote to a slot is added to the Gaussian's row."""
    source = inspect.getsource(adjoint.make_reverse)
    changed = source.replace(
        "slots_out[k, column] = total", "wp.atomic_add(slots_out, bins.instances[k], column, total)"
    )
    assert changed != source
    return defined("make_reverse", changed, dict(vars(adjoint)))("manual", variant)


class Blends:
    """The launches of a forward pass and its ``manual`` adjoint by the kernels of a GPU, one by one."""

    def __init__(self, gaussians: Gaussians, camera: Camera):
        self.camera, self.options = camera, RasterOptions()
        self.background = torch.zeros(3, device=gaussians.means.device)
        with torch.no_grad():
            self.splats = project(gaussians, camera, self.options)
            self.bins = CUDA.bin(self.splats, camera, self.options)
        self.count, new = len(gaussians.means), self.background.new_empty
        self.slots = new(len(self.bins.instances), variant_of(self.options).columns)
        self.forward()
        self.adj_pixels = Pixels(torch.ones_like(self.image), torch.zeros_like(self.image[..., 0]), new(0, 0))
        self.upstream(self.slots)
        self.rows = new(len(self.bins.gaussians), 9)

    def forward(self) -> None:
        pixels, self.saved = CUDA.blend(self.bins, self.camera, self.background, self.options, False)
        self.image = pixels.image

    def upstream(self, slots: torch.Tensor) -> None:
        states = (self.background, self.saved)
        found = CUDA.spread_upstream(self.bins, self.options, *states, self.adj_pixels, slots)
        (self.up, self.adj_final), _, _, self.steps, before = found
        CUDA.launch_tiles(self.bins, before)

    def reverse(self, kernel: wp.Kernel, rows: torch.Tensor) -> None:
        inputs = [self.bins.view(), alphas_of(self.options), *self.saved[:2], self.steps, self.up, self.adj_final]
        launch_blocks(kernel, len(self.bins.ranges), inputs, [rows], rows.device)

    def into_slots(self) -> None:
        self.reverse(adjoint.make_reverse("manual", variant_of(self.options)), self.slots)

    def longest_alone(self) -> "Blends":
        """The same with nothing to walk in all tiles but the one with most."""
        alone = copy.copy(self)
        alone.steps = torch.zeros_like(self.steps)
        alone.steps[self.steps.argmax()] = self.steps.max()
        return alone

    def gather(self) -> list[torch.Tensor]:
        return CUDA.gather(self.bins, self.slots)[:4]  # all but those of the depths

    def by_atomics(self) -> torch.Tensor:
        self.rows.zero_()
        self.reverse(make_adding_block(variant_of(self.options)), self.rows)
        return self.rows

    def by_gaussian(self, rows: torch.Tensor) -> torch.Tensor:
        """What is by splat: these are the Gaussians drawn, or all of them in another order."""
        found = rows.new_zeros(self.count, rows.shape[1])
        found[wp.to_torch(self.bins.gaussians).long()] = rows
        return found


def card_rates(device: str, count: int, rounds: int) -> tuple[float, float]:
    """Bytes that torch's copy of 16 times ``count`` reads and writes, and operations of multiply-adds, per second."""
    source = torch.ones(count, 4, device=device)
    target = torch.empty_like(source)
    copying = milliseconds(lambda: target.copy_(source), device, 10)
    threads = min(count, 2**20)
    adding = milliseconds(lambda: launch(multiply_add, threads, [rounds, 0.5], [source], device=device), device, 10)
    return 32e3 * count / copying, 2e3 * CHAINS * UNROLLED * rounds * threads / adding


def blends_of(model: GaussianModel, width: int, height: int) -> Blends:
    with torch.no_grad():
        return Blends(model.activated(), cameras(width, height, 1)[0])


def measure_longest(blends: Blends, device: str, repeats: int) -> list:
    """How much of the adjoint's time the tile with the longest list takes, alone on the card."""
    whole, alone = (milliseconds(b.into_slots, device, repeats) for b in (blends, blends.longest_alone()))
    steps = blends.steps.double()
    mean, most = float(steps.mean()), int(steps.max())
    return [len(steps), f"{mean:.0f}", most, f"{whole:.3f}", f"{alone:.3f}", f"{100 * alone / whole:.0f} %"]


def measure_blends(blends: Blends, size: str, device: str, repeats: int) -> tuple[list[list], list[list], float]:
    """Rows of shares and of slots against atomics, and by how much these two differ, relative."""
    bandwidth, arithmetic = card_rates(device, *((2**24, ROUNDS) if repeats > 1 else (2**16, 1)))
    runs = {
        "forward": blends.forward,
        "upstream": lambda: blends.upstream(blends.slots),
        "upstream without slots": lambda: blends.upstream(blends.slots[:, :0]),
        "adjoint into slots": blends.into_slots,
        "gather": blends.gather,
        "adjoint by atomics": blends.by_atomics,
    }
    times = {name: milliseconds(run, device, repeats) for name, run in runs.items()}
    walked, pixels, instances = int(blends.steps.sum()), len(blends.steps) * THREADS, len(blends.slots)
    work = {
        "forward": (walked * (SPLAT + INSTANCE) + 24 * pixels, FORWARD * walked * THREADS),
        "adjoint into slots": (walked * (SPLAT + INSTANCE + ROW) + 28 * pixels, ADJOINT * walked * THREADS),
        "gather": (instances * (INSTANCE + ROW) + blends.count * (ROW + 8), 9 * instances),
    }
    shares = [
        [name, f"{times[name]:.3f}", f"{size / 1e9:.3f}", f"{100e3 * size / times[name] / bandwidth:.1f}",
         f"{operations / 1e9:.2f}", f"{100e3 * operations / times[name] / arithmetic:.1f}"]
        for name, (size, operations) in work.items()
    ]  # fmt: skip
    shares += [["copy", "", f"{bandwidth / 1e9:.0f} per s", "100", "", ""]]
    shares += [["multiply-add", "", "", "", f"{arithmetic / 1e9:.0f} per s", "100"]]
    return shares, *_against_atomics(blends, times, size)


def _against_atomics(blends: Blends, times: dict[str, float], size: str) -> tuple[list[list], float]:
    """A row for each way, and by how much they differ."""
    first = blends.by_atomics().clone()
    repeated = torch.equal(first, blends.by_atomics())
    blends.into_slots()
    summed = torch.cat([grad.reshape(blends.count, -1) for grad in blends.gather()], 1)
    error = float((blends.by_gaussian(first) - summed).norm() / summed.norm())
    ways = {"slots": ("upstream", "adjoint into slots", "gather"),
            "atomics": ("upstream without slots", "adjoint by atomics")}  # fmt: skip
    rows = []
    for way, names in ways.items():
        parts = [times[name] for name in names]
        cells = [f"{part:.3f}" for part in (*parts, *[0.0] * (3 - len(parts)), sum(parts))]
        same = way == "slots" or repeated
        rows.append([size, blends.count, len(blends.slots), way, *cells, "yes" if same else "no"])
    return rows, error
