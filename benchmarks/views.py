"""What does one call for several views save? Eight views of 270 x 480 px at 194k Gaussians, forward and adjoint.

Either way one backward pass adds up the gradients of all views. Rounds go over all rows, so that the machine's pace
hits them alike, and the least of each counts. About 3 minutes.

    python benchmarks/views.py [--threads 2] [--out docs/benchmarks]
"""

import time
from collections.abc import Callable

import torch
from audit_targets.own import matrices_of
from common import REPEATS, option, parse, write_table
from made_up import cameras, make_gaussians

from warp_splat import rasterize, rasterize_views
from warp_splat.camera import Camera
from warp_splat.gsplat import rasterization
from warp_splat.runtime.launch import prepare

COUNT, SIZE, VIEWS = 194_000, (270, 480), 8
TIMES = ("elapsed", "processor")
PER_TIME = ("eight calls ms", "one call ms", "less")
HEADERS = ("function", *(f"{time}: {what}" for time in TIMES for what in PER_TIME), "gradients apart")


def by_ours(leaves: list[torch.Tensor], seen: list[Camera], together: bool) -> list[torch.Tensor]:
    """Images of ``rasterize`` or ``rasterize_views``; harmonics in one tensor or as a pair."""
    *shapes, sh = leaves if len(leaves) == 5 else (*leaves[:4], tuple(leaves[4:]))
    if together:
        return [out.image for out in rasterize_views(*shapes, sh, seen)]
    return [rasterize(*shapes, sh, camera).image for camera in seen]


def by_gsplats(leaves: list[torch.Tensor], seen: list[Camera], together: bool) -> list[torch.Tensor]:
    """Images of gsplat's function."""
    viewmats, Ks = (torch.stack(matrices) for matrices in zip(*map(matrices_of, seen), strict=True))
    calls = [slice(None)] if together else [slice(index, index + 1) for index in range(len(seen))]
    images = [rasterization(*leaves, viewmats[call], Ks[call], *SIZE, sh_degree=3)[0] for call in calls]
    return list(torch.cat(images))


def measure(run: Callable, given: list[torch.Tensor], seen: list[Camera], upstream, together: bool):
    """Elapsed and processor seconds, images and gradients."""
    leaves = [tensor.clone().requires_grad_() for tensor in given]
    begun, used = time.perf_counter(), time.process_time()
    images = run(leaves, seen, together)
    torch.autograd.backward(images, upstream)
    times = time.perf_counter() - begun, time.process_time() - used
    return times, [image.detach() for image in images], [leaf.grad for leaf in leaves]


def main() -> None:
    arguments = parse(__doc__, option("--threads", type=int, default=2), REPEATS)
    device = prepare("cpu", arguments.threads)
    seen = cameras(*SIZE, VIEWS)
    with torch.no_grad():
        pair = [tensor.detach() for tensor in make_gaussians(COUNT, device.type).activated()]
    whole = [*pair[:4], torch.cat(pair[4:], 1)]
    upstream = list(torch.rand(VIEWS, SIZE[1], SIZE[0], 3))
    runs = {
        "`rasterize_views`, harmonics in one tensor": (by_ours, whole),
        "`rasterize_views`, harmonics as a pair": (by_ours, pair),
        "`gsplat.rasterization`": (by_gsplats, whole),
    }
    seconds, apart = {name: ([], []) for name in runs}, {}
    for repeat in range(arguments.repeats + 1):
        for name, (run, given) in runs.items():
            (alone, images, grads), (together, *same) = (
                measure(run, given, seen, upstream, one_call) for one_call in (False, True)
            )
            assert all(map(torch.equal, images, same[0])), name
            apart[name] = max(float((a - b).norm() / b.norm()) for a, b in zip(grads, same[1], strict=True))
            for found, times in zip(seconds[name], (alone, together), strict=True):
                found.extend([times] * (repeat > 0))
    rows = []
    for name, both in seconds.items():
        row = [name]
        for kind in range(len(TIMES)):
            alone, together = (min(times[kind] for times in found) for found in both)
            row += [f"{1e3 * alone:.0f}", f"{1e3 * together:.0f}", f"{100 * (1 - together / alone):.0f} %"]
        rows.append((*row, f"{apart[name]:.0e}" if apart[name] else "no bit"))
    note = (
        f"{VIEWS} views of {SIZE[0]} x {SIZE[1]} px, {COUNT} Gaussians of degree 3, {arguments.threads} threads; "
        "forward and adjoint, the least of all rounds. Images are equal bit for bit; gradients: relative L2 of the "
        "worst."
    )
    write_table("views", arguments.out, HEADERS, rows, note, {"seconds": seconds})


if __name__ == "__main__":
    main()
