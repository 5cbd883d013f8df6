"""What do channels beside the color cost? 100k Gaussians at 980 x 545, whole calls on one thread.

Processor seconds of the process, the least of all rounds; rounds go over all rows, so that the machine's pace hits them
alike. Backward passes start from the gradient of what the row adds, and of the color. Memory: the largest sum of
torch's tensors, with and without what goes in, comes out, and their gradients. About 4 minutes.

    python benchmarks/channels.py [--out docs/benchmarks]
"""

import time

import torch
from common import REPEATS, option, parse, write_table
from made_up import cameras, make_gaussians

from warp_splat.compare.adjoints import peak_of
from warp_splat.config import RasterOptions
from warp_splat.raster.api import render
from warp_splat.raster.data import Gaussians
from warp_splat.runtime.launch import prepare

COUNT, SIZE = 100_000, (980, 545)
FEATURES = (1, 3, 8, 32, 128, 512)
ASKED = {
    "normals": RasterOptions(normals=True),
    "median depth": RasterOptions(median_depth=True),
    "strongest, 1": RasterOptions(strongest=1),
    "strongest, 8": RasterOptions(strongest=8),
    "expected depth": RasterOptions(depth=True),
}
SHOWN = ("features", "normals", "median_depth", "strongest_weights", "depth")


def main() -> None:
    arguments = parse(
        __doc__,
        REPEATS,
        option("--most", type=int, default=max(FEATURES), help="leave out more channels than this"),
    )
    device = prepare("cpu", 1)
    torch.manual_seed(0)
    (camera,) = cameras(*SIZE, 1)
    with torch.no_grad():
        gaussians = Gaussians(*(tensor.detach() for tensor in make_gaussians(COUNT, device.type).activated()))
    rows = {"color": (RasterOptions(), 0)}
    rows |= {f"color, {count} channels": (RasterOptions(), count) for count in FEATURES if count <= arguments.most}
    rows |= {f"color, {name}": (options, 0) for name, options in ASKED.items()}
    seconds = {name: ([], []) for name in rows}
    for repeat in range(arguments.repeats + 1):
        for name, (options, count) in rows.items():
            *times, _ = once(gaussians, camera, options, count)
            for found, value in zip(seconds[name], times, strict=True):
                found.extend([value] * (repeat > 0))
    least = {name: [min(values) for values in both] for name, both in seconds.items()}
    memory = {}
    for name, (options, count) in rows.items():
        given: list[int] = []
        peak = peak_of(lambda: given.append(once(gaussians, camera, options, count)[-1]), device)  # noqa: B023
        memory[name] = (peak, peak - given[0])
    table = [
        (
            name,
            *(f"{1e3 * value:.0f}" for value in both),
            *(f"{a / b:.2f}" for a, b in zip(both, least["color"], strict=True)),
            *(f"{bytes / 2**20:.0f}" for bytes in memory[name]),
        )
        for name, both in least.items()
    ]
    times = ("forward ms", "backward ms", "forward x color", "backward x color")
    headers = ("what is blended", *times, "peak MiB", "in between MiB")
    note = (
        f"{COUNT} Gaussians, {SIZE[0]} x {SIZE[1]} px, one thread, processor time, whole calls. In between: without "
        "what goes in, comes out, and their gradients."
    )
    write_table("channels", arguments.out, headers, table, note, {"seconds": least, "bytes": memory})


def once(gaussians: Gaussians, camera, options: RasterOptions, count: int) -> tuple[float, float, int]:
    """Processor seconds forward and backward, and the bytes of inputs, outputs and their gradients."""
    leaves = Gaussians(*(tensor.clone().requires_grad_() for tensor in gaussians))
    features = torch.rand(COUNT, count).requires_grad_() if count else None
    start = time.process_time()
    out = render(leaves, camera, torch.zeros(3), options, "manual", features)
    middle = time.process_time()
    shown = [out.image, *(tensor for name in SHOWN if (tensor := getattr(out, name)) is not None)]
    upstream = [torch.rand_like(tensor) for tensor in shown]
    begun = time.process_time()
    torch.autograd.backward(shown, upstream)
    end = time.process_time()
    tensors = [*leaves, *shown, *([] if features is None else [features])]
    return middle - start, end - begun, 2 * sum(tensor.nbytes for tensor in tensors)


if __name__ == "__main__":
    main()
