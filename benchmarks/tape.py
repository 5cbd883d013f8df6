"""What does the tape cost beside torch? Whole calls with checks, forward and backward, on one thread.

The same Gaussians by `warp_splat.rasterize` and by `warp_splat.tape.rasterize`; images and gradients must be equal bit
for bit. Processor time, the least of all rounds. About a minute.

    python benchmarks/tape.py [--out docs/benchmarks]
"""

import time

import torch
import warp as wp
from common import option, parse, write_table
from made_up import cameras, make_gaussians

from warp_splat import rasterize, tape
from warp_splat.runtime import timers
from warp_splat.runtime.launch import prepare

SCENES = ((1_000, (64, 64)), (10_000, (270, 480)), (100_000, (980, 545)))
PARTS = ("forward", "backward")


def by_torch(given: list[torch.Tensor], camera, upstream: torch.Tensor):
    """Processor seconds of both parts, and what came out."""
    leaves = [tensor.clone().requires_grad_() for tensor in given]
    begun = time.process_time()
    image = rasterize(*leaves, camera).image
    middle = time.process_time()
    image.backward(upstream)
    times = middle - begun, time.process_time() - middle
    return times, [image.detach(), *(leaf.grad for leaf in leaves)]


def on_tape(given: list[torch.Tensor], camera, upstream: torch.Tensor):
    """Likewise; the gradients exist, and are zero, before."""
    arrays = [wp.from_torch(tensor.clone(), requires_grad=True) for tensor in given]
    begun = time.process_time()
    with wp.Tape() as recorded:
        out = tape.rasterize(*arrays, camera)
    middle = time.process_time()
    recorded.backward(grads={out.image: wp.from_torch(upstream, wp.vec3)})
    times = middle - begun, time.process_time() - middle
    return times, [wp.to_torch(array) for array in (out.image, *(array.grad for array in arrays))]


def main() -> None:
    arguments = parse(__doc__, option("--repeats", type=int, default=15))
    device = prepare("cpu", 1)
    rows, seconds = [], {}
    for count, size in SCENES:
        with torch.no_grad():
            *shapes, dc, rest = (tensor.detach() for tensor in make_gaussians(count, device.type).activated())
        given, (camera,) = [*shapes, torch.cat([dc, rest], 1)], cameras(*size, 1)
        upstream, found = torch.rand(size[1], size[0], 3), {"torch": [], "tape": [], "its own part": []}
        for repeat in range(arguments.repeats + 1):
            times, expected = by_torch(given, camera, upstream)
            with timers.profile() as stages:
                taped, same = on_tape(given, camera, upstream.clone())
            assert all(map(torch.equal, expected, same))
            if repeat:
                found["torch"].append(times)
                found["tape"].append(taped)
                found["its own part"].append((stages["tape"], stages["adjoint of tape"]))
        least = {name: [min(column) for column in zip(*values, strict=True)] for name, values in found.items()}
        rows.append((count, f"{size[0]} x {size[1]}", *(f"{1e3 * v[i]:.2f}" for i in (0, 1) for v in least.values())))
        seconds[count] = least
    headers = (
        "Gaussians",
        "px",
        *(f"{part} ms: {name}" for part in PARTS for name in ("torch", "tape", "its own part")),
    )
    note = "Whole calls with the checks of their input, one thread, processor time; its own part by the clock."
    write_table("tape", arguments.out, headers, rows, note, {"seconds": seconds})


if __name__ == "__main__":
    main()
