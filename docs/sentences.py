"""The figures in pages: those in running text; of adjoints.md in sentences_adjoints.py. Tables: page_tables.py.

A page stays plain Markdown. Its function in ``SENTENCES`` repeats the text around each figure, with ``{}`` for it, and
says what stands there. docs/make_pages.py writes it into the page, and raises an error if the text is not there. A
figure that no file holds is said to be measured by hand, once.
"""

import re

import figures as f
from sentences_adjoints import adjoints

POSES = "--parts pose", "--parts pose --pose_intrinsics focal"


def _scaling() -> list[tuple]:
    records = f.data("blocks")["records"]
    street, again, ring = (
        [
            [f"{whole[place] - blocks[place]:.2f}" for place in ("rest", "seams")]
            for whole, blocks in zip(rows, others, strict=True)
        ]
        for rows, others in ((records[k : k + 8 : 2], records[k + 1 : k + 8 : 2]) for k in (0, 8, 16))
    )
    after = lambda run: [pair[place] for place in (0, 1) for pair in run[1:]]  # noqa: E731
    on_eight, largest = (
        row for row in f.data("sharding_model")["rows"] if row["gaussians"] == 1000 and row["by"] == "a core"
    )
    return [
        (
            "on 64 of them a step takes {} s, and an image {} s: 30,000 images are {} hours. On eight, an "
            "image takes {} s.",
            f"{largest['own'] + largest['drawing'] + largest['exchange']:.0f}",
            f"{largest['image']:.1f}",
            f"{30_000 * largest['image'] / 3600:.0f}",
            f"{on_eight['image']:.0f}",
        ),
        (
            "street's blocks are {} dB behind away from the borders, and {} dB at them, with another seed {} and {}:",
            *(*street[0], *again[0]),
        ),
        ("On fox they are {} and {} dB behind", *ring[0]),
        (
            "blocks are {}, {} and {} dB behind away from the borders and {}, {} and {} dB at them, of the undivided "
            "training with as many steps more; with another seed {}, {} and {}, and {}, {} and {} dB. On fox it is {}, "
            "{} and {}, and {}, {} and {} dB.",
            *(*after(street), *after(again), *after(ring)),
        ),
        ("A billion takes {} GB on each of eight", f"{on_eight['held']:.0f}"),
    ]


def _readme() -> list[tuple]:
    sizes = {(scene, ending): float(each) for scene, _, ending, each, *_ in f.data("formats")["rows"]}
    return [
        (
            "version 2, {} to {} times the size of `.spz`",
            *f.span([sizes[scene, "`.sog`"] / sizes[scene, "`.spz`"] for scene in ("fox", "church")], f.two),
        ),
        (
            "its two passes take {} ms for a million Gaussians where gsplat's take {}. But",
            *(f.one(float(row["forward + backward ms"])) for row in f.on_card("Beside gsplat")),
        ),
        ("The training takes {} s on two cores", f.data("preset")["rows"][0][6]),
        (
            "In the worst of {} stiff and extreme cases, gradients err by {}.",
            f.cases(),
            f.small(max(float(row["gradient_error"] or 0) for row in f.rows("stability"))),
        ),
        ("recorded naively is wrong by {} %", round(100 * min(f.errors("plain")))),
        ("Without them it takes {} to {} times the time", *f.span(f.times_manual("generated"), "{:.0f}".format)),
        ("the adjoint takes up to {} times as long", f.two(max(f.times_manual("stepwise")))),
        ("modes differ by {} dB, seeds by {} dB", *f.scatter()),
        ("shrink from {} lines to {}.", f.rules("manual"), f.rules("stepwise")),
        ("Measured on {}, by `uv run python -m warp_splat.compare`", f.compared_on()),
    ]


def _renderer() -> list[tuple]:
    return [
        ("the forward pass is {} times as fast", round(f.blend_gain())),
        ("exactly enough ({} after 100,000", f.small(f.recovered(100_000))),
        ("has the catalog of {} stiff", f.cases()),
    ]


def _extending() -> list[tuple]:
    return [
        ("`: {} stiff and extreme cases, {} verdicts over", f.cases(), len(f.rows("stability"))),
    ]


def _steps() -> list[tuple]:
    return [
        (
            "Two threads do {} times the multiply-adds of one, and moved {} times the bytes in that run",
            f.two(f.of_two_threads("rate")),
            f.two(f.of_two_threads("bandwidth")),
        ),
        (
            "pixels: {} times as many in `full`, {} times where",
            f.one(f.looked_at("full")),
            f.one(f.looked_at("synthetic")),
        ),
        (
            "saw the Gaussian: {} and {} times as many",
            f.one(f.looked_at("full", "by_adjoint")),
            f.one(f.looked_at("synthetic", "by_adjoint")),
        ),
    ]


def _performance() -> list[tuple]:
    return [
        ("two processes see {} times the images per second", f.two(f.images_gained())),
    ]


def _shutters() -> list[tuple]:
    return [
        (
            "find the means to within {} px, one step to within {} px.",
            *(f.small(max(f.shutter(way, "off"))) for way in ("two steps", "one step")),
        ),
        ("the adjoint has {} registers, without spills", f.registers("project, rolling shutter")[0]),
        ("Pictures then reach {} to {} dB, where", *f.span(f.shutter("two steps", "psnr"), f.one)),
        ("stands still reaches {} to {} dB.", *f.span(f.shutter("standing still", "psnr"), f.one)),
    ]


def _simulation() -> list[tuple]:
    return [
        (
            "ours draws {} times as many pictures a second as Newton's, on two {} times as many. All views in one call "
            "take {} of the time of a call for each.",
            *(round(f.simulated(f"ours, {way}", 3) / f.simulated("Newton's", 3)) for way in ("1 thread", "2 threads")),
            f.two(f.simulated("ours, a call for each", 3) / f.simulated("ours, 1 thread", 3)),
        ),
        ("mean error of a color is {},", f.small(f.simulated("Newton's", 5))),
        ("Ours errs by at most {}.", f.small(f.simulated("ours, 1 thread", 4))),
    ]


def _cameras() -> list[tuple]:
    return [
        (
            "All {} get there, after {} steps at most, and end within {} degrees, {} mm and {} %.",
            *(len(f.data("cameras")["reached"]), max(f.data("cameras")["reached"])),
            *(f.small(unit * max(f.data("cameras")["last"][of])) for of, unit in f.CAMERA_ERRORS.items()),
        ),
        (
            "footprints of `affine` reach {} dB, those of `unscented` {} dB; through a wide lens {} and {} dB.",
            *(f.one(f.footprint(lens, way, "0.03")) for lens in ("OPENCV_FISHEYE", "OPENCV,") for way in f.WAYS),
        ),
        (
            "7 degrees: {} and {} dB through the fisheye, {} and {} dB through the wide lens",
            *(f.one(f.footprint(lens, way, "0.12")) for lens in ("OPENCV_FISHEYE", "OPENCV,") for way in f.WAYS),
        ),
        (
            "both are wrong, by up to {} of a color of 1",
            f.two(max(f.footprint("EQUI", way, size, "max") for way in f.WAYS for size in ("0.03", "0.12"))),
        ),
        (
            "take {} times as long through the fisheye as a pinhole's, `unscented` {} times",
            *(f.two(f.footprint("OPENCV_F", w, "0.03", "seconds", "pinhole")) for w in f.WAYS),
        ),
        (
            "are off by {}, the largest seen, relative to float64, over all",
            f.off_by("gaussians"),
        ),
        *((f"{where} | {{}} |", f.off_by(*parts)) for where, parts in f.LEARNED.items()),
        (
            "px takes {} % longer with a camera that learns its pose, fx, fy, cx and cy. Through an OPENCV lens it "
            "takes {} % longer if that learns all of them and its four coefficients, {} % by the unscented "
            "transform (one thread, processor time, {}).",
            *(f.one(100 * price["added"] / price["step"]) for price in f.data("cameras")["prices"].values()),
            f.data("cameras")["machine"],
        ),
        ("projection and adjoint take up to {} times as long if all is learned.", f.two(f.rolling_price())),
    ]


def _cuda() -> list[tuple]:
    million = ("980 x 545", 1_000_000)
    small, large = (f.on_card("Training step", size, count)[0] for size, count in (("64 x 64", 100), million))
    huge = f.on_card("Training step", "980 x 545", 5_000_000)[0]
    modes = f.on_card("Adjoints: time and memory", "980 x 545", 5_000_000)
    kernels = {row["kernel"].split("__")[0]: float(row["ms per step"]) for row in f.on_card("Kernels of a step")}
    beside = f.on_card("Beside gsplat", *million)
    ways = [row["sum ms"] for row in f.on_card("Slots against atomics")]
    errors = [row for row in f.on_card("Adjoints: error against time", scene=f.MANY) if row["variant"] in f.MODES]
    shares = [row["share"].rstrip(" %") for row in f.on_card("Longest tile")]
    own, apart, other = (f.data("simulation_cuda")["rows"][place][3] for place in range(3))
    return [
        ("the image is the CPU's within {}, the gradients within {},", *f.off_on_card()),
        (
            "A step of 100 Gaussians on 64 x 64 px takes {} ms, and its kernels {} ms. With a million on 980 x 545 px "
            "it takes {} ms, its kernels {} ms.",
            *(row[what] for row in (small, large) for what in ("step ms", "kernels ms")),
        ),
        ("five million the kernels are all there is: {} of {} ms.", huge["kernels ms"], huge["step ms"]),
        (
            "`manual` {} ms, `stepwise` {}, `reversible` {}, `stored` {} with {} MiB instead of {}.",
            *(row["forward + backward ms"] for row in modes),
            *(modes[place]["peak MiB"] for place in (3, 0)),
        ),
        ("at most {} of float64's", max((row["error"] for row in errors), key=float)),
        (
            "it draws {} pictures a second without it and {} with it,",
            *(round(float(row["frames per second"])) for row in f.on_card("Orbit")),
        ),
        (
            "forward {} ms, gsplat {}; both passes {} ms, gsplat {}. Both hold",
            *(row[what] for what in ("forward ms", "forward + backward ms") for row in beside),
        ),
        (
            "take {} ms for the ball, atomic additions {}; for the crowd {} and {}. So",
            *(f.two(float(way)) for way in ways),
        ),
        (
            "Now a thread has one coefficient: {} ms instead of",
            f.two(kernels["make_adj_shade"] + kernels["make_adj_rest"]),
        ),
        (
            "with Adam: {} and {} ms of a million. By events it is {} ms, and the longest tile, alone, takes {} % of",
            *(f.two(kernels[name]) for name in ("make_reverse", "make_adam_by_number")),
            f.two(float(f.on_card("Longest tile")[0]["adjoint ms"])),
            shares[0],
        ),
        ("the longest tile of the ball takes {} % of the adjoint's time, that of the crowd {} %;", *shares),
        (
            "it draws {} pictures a second in one pass, and {} if each view is a call; Newton's own sensor draws {} (",
            *map(f.thousands, (own, apart, other)),
        ),
        ("the blend has {} registers and", f.registers("blend")[0]),
        ("shared memory, {} % of the threads of an sm_90 are resident", f.resident("blend")),
        (
            "Its adjoints have {} to {} registers,",
            *f.span(f.registers("manual", "stepwise", "reversible", "stored"), str),
        ),
        ("the adjoint of the ball takes {} to {} ms,", *f.loads("ball", "one for a tile")),
        ("ms, not {}: its 2,170 tiles", *f.loads("ball", "one for a tile", "slots busy: ms")),
        (
            "pixels a lane take {} to {} ms for the ball's adjoint, but {} to {} for the crowd's, {} to {} now",
            *f.loads("ball", "two of four pixels a lane"),
            *f.loads("crowd", "two of four pixels a lane"),
            *f.loads("crowd", "one for a tile"),
        ),
        ("Lists split at 256 take {} to {} (ball)", *f.loads("ball", "one for 256 of a list")),
        ("the longest tiles first, {} (crowd)", f.loads("crowd", "one for a tile, the longest first")[1]),
        ("registers, {} % (`stored` {}).", f.resident("manual"), f.resident("stored")),
        (
            "The adjoint of projection has {} registers, {} %, that of colors {}.",
            f.registers("project")[0],
            f.resident("project"),
            f.registers("adjoint of shade")[0],
        ),
    ]


def _captures() -> list[tuple]:
    runs = f.data("poses")["runs"]
    (best, *_), posed, focal = (runs[f"right, {more}"] for more in ("none", *POSES))
    (worst, *_), posed_back, focal_back = (runs[f"wrong, {more}"] for more in ("none", *POSES))
    shares = [f"{100 * (psnr - worst) / (best - worst):.0f}" for psnr, *_ in (focal_back, posed_back)]
    return [
        (
            "\n- {} % of what the faults cost comes back ({} of {} dB), and {} % with the poses alone",
            *(shares[0], f.two(focal_back[0] - worst), f.two(best - worst), shares[1]),
        ),
        (
            "`pose` costs {} dB, and with `--pose_intrinsics focal` {} dB",
            *(f.two(best - psnr) for psnr, *_ in (posed, focal)),
        ),
        ("\n- {} % of the focal length's fault", f"{100 - 1e4 * focal_back[4]:.0f}"),
    ]


#: By page: pieces of its text, with ``{}`` for a figure, and the figures.
def _gradients() -> list[tuple]:
    found = f.data("numerics")["rows"]
    of = lambda what, key="measured": [row[key] for row in found if re.search(what, row["what"])]  # noqa: E731
    cuts, stops = of("by the cut"), of("by the stop")
    return [
        ("that of rounding: {} to {} % of", *f.span([100 * cut for cut in cuts], "{:.0f}".format)),
        ("that with the cut is {} to {} times as", *f.span(of("by the cut", "along"), f.two)),
        (
            "The stop matters {} to {} times",
            *f.span([cut / stop for cut, stop in zip(cuts, stops, strict=True)], "{:.0f}".format),
        ),
        ("pixel by {} in the mean", f.small(max(of("what one changes")))),
        ("the brightest color, {} to {}. No", *f.span(of("what one changes", "bound"), f.small)),
        ("Two orders are\n{} apart", f.small(f.mean(of("two such sums")))),
    ]


SENTENCES = {
    "scaling.md": _scaling,
    "README.md": _readme,
    "renderer.md": _renderer,
    "extending.md": _extending,
    "adjoints.md": adjoints,
    "steps.md": _steps,
    "performance.md": _performance,
    "shutters.md": _shutters,
    "simulation.md": _simulation,
    "cameras.md": _cameras,
    "cuda.md": _cuda,
    "captures.md": _captures,
    "gradients.md": _gradients,
}


def filled(name: str, page: str) -> str:
    """The text of a page with its figures.

    Raises:
        LookupError: if a sentence is not in it, or more than once.
    """
    for sentence, *values in SENTENCES[name]() if name in SENTENCES else ():
        pieces = [re.sub(r"(?:\\?\s)+", r"\\s+", re.escape(piece)) for piece in sentence.split("{}")]
        found = list(re.finditer(r"([^|]{1,60}?)".join(pieces), page))
        if len(found) != 1:
            raise LookupError(f"{name}: expected once, found {len(found)} times: {sentence}")
        for number, value in reversed(list(enumerate(values, 1))):
            if " ".join(found[0][number].split()) != str(value):
                page = page[: found[0].start(number)] + str(value) + page[found[0].end(number) :]
    return page
