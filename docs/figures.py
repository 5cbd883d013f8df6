"""What was measured, from the files that benchmarks and ``warp-splat compare`` wrote."""

import csv
import functools
import json
import re
from collections.abc import Callable
from pathlib import Path
from statistics import mean

DOCS = Path(__file__).parent
MODES = ("manual", "stepwise", "reversible", "stored")
WITH_GENERATED = (*MODES, "generated")
EMBEDDED = "embedded, step 300"
MANY = "10000 layers"


@functools.cache
def text(name: str) -> str:
    """A file of docs/."""
    return (DOCS / name).read_text()


@functools.cache
def data(name: str) -> dict:
    """A JSON file of benchmarks/."""
    return json.loads(text(f"benchmarks/{name}.json"))


@functools.cache
def rows(name: str) -> list[dict[str, str]]:
    """A CSV file of compare/."""
    found = list(csv.DictReader(text(f"compare/{name}.csv").splitlines()))
    return [{**row, "variant": row.get("variant", "").removesuffix(" *")} for row in found]  # * marks a default


def quoted(name: str, pattern: str) -> list[str]:
    """The groups of a pattern in a file, where it is found first."""
    return list(re.search(pattern, text(name)).groups())


def on_card(table: str, size: str = "", count: int = 0, **more: str) -> list[dict]:
    """Rows of a table of gpu.json, of a size and a number of Gaussians, if these are given."""
    wanted = {**({"size": size} if size else {}), **({"Gaussians": count} if count else {}), **more}
    return [row for row in data("gpu")["tables"][table] if wanted.items() <= row.items()]


def off_on_card() -> tuple[str, str]:
    """The largest errors of an image and of a gradient against the CPU, over all modes and cases."""
    found = {row["check"]: [] for row in on_card("Checks") if "against the CPU" in row["check"]}
    for row in on_card("Checks"):
        found.get(row["check"], []).append(row["found"])
    of = lambda image: max((v for k, s in found.items() if (": image" in k) == image for v in s), key=float)  # noqa: E731
    return of(True), of(False)


def thousands(shown: str) -> str:
    """10,631."""
    return f"{round(float(shown)):,}"


def compared_on() -> str:
    """The machine of ``warp-splat compare``."""
    return quoted("compare/compare.txt", r"Measured on (.*), 2 threads")[0]


def scatter() -> list[str]:
    """Standard deviations of PSNR [dB] over adjoints, and over seeds."""
    return quoted("compare/training.txt", r"is ([\d.]+) dB over modes and ([\d.]+) dB over seeds")


def small(value: float) -> str:
    """2e-3."""
    return re.sub(r"e([+-])0*(\d+)", lambda found: f"e{found[1].replace('+', '')}{found[2]}", f"{value:.0e}")


def span(values: list[float], shown: Callable[[float], str]) -> tuple[str, str]:
    """The least and the largest."""
    return shown(min(values)), shown(max(values))


def two(value: float) -> str:
    """1.05."""
    return f"{value:.2f}"


def one(value: float) -> str:
    """1.1."""
    return f"{value:.1f}"


WAYS = ("affine", "unscented")  # through a lens


def footprint(camera: str, projection: str, size: str, key: str = "psnr", per: str = "") -> float:
    """A figure of compare/cameras.csv, of the camera whose name begins so; divided by another."""
    wanted = (row for row in rows("cameras") if (row["projection"], row["size"]) == (projection, size))
    row = next(row for row in wanted if row["camera"].startswith(camera))
    return float(row[key]) / (float(row[per]) if per else 1.0)


def off_by(*parameters: str) -> str:
    """The largest error of these gradients in compare/cameras_gradients.csv."""
    found = [float(row["error"]) for row in rows("cameras_gradients") if row["parameter"] in parameters]
    return f"{max(found):.1e}".replace("e-0", "e-")


def rolling_price() -> float:
    """Projection and adjoint of a camera with a rolling shutter that learns, over those of one that does not."""
    found = [row for row in rows("cameras_gradients") if "rolling" in row["camera"]]
    return max(float(row["learned"]) / float(row["still"]) for row in found)


def simulated(renderer: str, column: int) -> float:
    """A figure of simulation.json."""
    return next(float(row[column]) for row in data("simulation")["rows"] if row[0] == renderer)


def shutter(way: str, key: str) -> list[float]:
    """Figures of shutter.json, of one way to draw."""
    return [record[key] for record in data("shutter")["records"] if record["way"] == way]


def worst(table: str, scene: str, variant: str) -> float:
    """The largest of the six gradients' relative errors."""
    found = (row for row in rows(table) if (row["scene"], row["variant"]) == (scene, variant))
    return max(float(row["relative_error"]) for row in found if row["parameter"] != "background")


def scenes(table: str = "adjoints") -> list[str]:
    """Those that were measured."""
    return list(dict.fromkeys(row["scene"] for row in rows(table)))


def errors(*modes: str) -> list[float]:
    """Of the worst gradient, over all scenes."""
    return [worst("adjoints", scene, mode) for scene in scenes() for mode in modes]


def fact(table: str, scene: str, variant: str, name: str) -> float:
    """A number of the first row of a measurement."""
    return next(float(row[name]) for row in rows(table) if (row["scene"], row["variant"]) == (scene, variant))


def seconds(mode: str, what: str, threads: int) -> float:
    """Of 100,000 Gaussians: what is "forward" or "adjoint"."""
    return data("adjoints")["seconds"][f"{mode} {what} {threads}"]


def times_manual(mode: str) -> list[float]:
    """Time of the adjoint relative to the one by hand, over all scenes and the benchmark."""
    over_scenes = [_backward(scene, mode) / _backward(scene, "manual") for scene in scenes()]
    return over_scenes + [seconds(mode, "adjoint", n) / seconds("manual", "adjoint", n) for n in (1, 2)]


def _backward(scene: str, mode: str) -> float:
    return fact("adjoints", scene, mode, "backward_seconds")


def rules(mode: str) -> int:
    """Lines that state a derivative or an inverse."""
    return data("derivatives")[mode]["rules"]


def plumbing(mode: str) -> int:
    """The other lines of a derivative."""
    return data("derivatives")[mode]["plumbing"]


def mebibytes(mode: str) -> int:
    """Peak memory of 100,000 Gaussians."""
    return round(data("adjoints")["peak_bytes"][mode] / 2**20)


def knob(scene: str, variant: str) -> tuple[float, float, float]:
    """Error of the image, error of the worst gradient, seconds forward and backward."""
    times = [fact("knobs", scene, variant, f"{way}_seconds") for way in ("forward", "backward")]
    return fact("knobs", scene, variant, "image_error"), worst("knobs", scene, variant), sum(times)


def slower(variant: str, default: str, scene: str = EMBEDDED) -> float:
    """Time against a default."""
    return knob(scene, variant)[2] / knob(scene, default)[2]


def stability(case: str, name: str) -> float:
    """The worst of a case over the modes: name is "value_error" or "gradient_error"."""
    return max(float(row[name]) for row in rows("stability") if row["case"] == case and row[name])


def recovered(layers: int) -> float:
    """How far T is off after so many layers and back."""
    return next(float(r["error"]) for r in rows("rounding") if r["what"][0] == "T" and int(r["of"]) == layers)


def rung(scene: str, name: str, column: str) -> float:
    """Of the splats against the truth."""
    found = (row for row in rows("volume") if row["table"] == "ladder" and (row["scene"], row["rung"]) == (scene, name))
    return float(next(found)[column])


def cases() -> int:
    """Of the catalog of stiff and extreme ones."""
    return len({row["case"] for row in rows("stability")})


def psnr(variant: str) -> float:
    """Held-out, the mean over the seeds [dB]."""
    return mean(float(row["psnr"]) for row in rows("training") if row["variant"] == variant)


def lost(variant: str) -> float:
    """PSNR [dB] below ``manual`` with the same seed, the mean."""
    by_hand = {row["seed"]: float(row["psnr"]) for row in rows("training") if row["variant"] == "manual"}
    return mean(by_hand[row["seed"]] - float(row["psnr"]) for row in rows("training") if row["variant"] == variant)


def nearer() -> list[float]:
    """How much closer modes are than seeds, before the first densification (rms)."""
    found = re.findall(r"\| (modes|seeds) .*\| +([\d.e-]+) \|", text("compare/training.txt"))
    values = [float(value) for _, value in found]
    return [seeds / modes for modes, seeds in zip(values[::2], values[1::2], strict=True)]


def integrated(method: str) -> float:
    """Error at an optical depth of 1 by 64 samples."""
    key = ("integrators", 1.0, method, "64")
    found = (row for row in rows("volume") if row["table"] == key[0] and (row["method"], row["samples"]) == key[2:])
    return next(float(row["error"]) for row in found if float(row["optical_depth"]) == key[1])


def shortcut(name: str) -> list[float]:
    """Mean errors of what one shortcut adds, over the six scenes."""
    return [float(row["own_mean"]) for row in rows("volume") if (row["table"], row["rung"]) == ("ladder", name)]


def gained() -> list[float]:
    """PSNR [dB] of ellipsoids against affine, where no Gaussians overlap."""
    alone = ("one", "separated", "needle along its axis", "needle at the edge")
    return [rung(scene, "ellipsoid", "psnr") - rung(scene, "affine", "psnr") for scene in alone]


def stored_to_reversible() -> list[float]:
    """Times of the two adjoints, over all scenes and the benchmark."""
    return [stored / undone for stored, undone in zip(times_manual("stored"), times_manual("reversible"), strict=True)]


def spread_of_modes() -> float:
    """The largest ratio of the errors of two of the four modes on one scene."""
    return max(max(found) / min(found) for found in ([worst("adjoints", s, m) for m in MODES] for s in scenes()))


def stage(size: str, name: str, threads: int) -> float:
    """Seconds of a stage of a training step."""
    return data("step")[size]["seconds"][str(threads)][name]


def projection_backwards() -> float:
    """Time of its adjoint, with that of colors, relative to the projection."""
    return stage("full", "adjoint of project", 1) / stage("full", "project", 1)


def registers(*modules: str) -> list[int]:
    """The most of any architecture, of each kernel without depth that writes gradients."""
    found = [row for row in data_of_cubins() if row["module"] in modules and row["kernel"] not in ("walk", "project")]
    return [max(row["registers"] for row in found if row["module"] == module) for module in modules]


def resident(module: str) -> str:
    """The share of an sm_90's threads [%]."""
    kernels = [row for row in data_of_cubins() if row["module"] == module and row["arch"] == 90]
    return f"{100 * min(row['occupancy'] for row in kernels):.0f}"


@functools.cache
def data_of_cubins() -> list[dict]:
    """What the compiler says of each kernel and architecture."""
    return json.loads(text("cuda/cubins.json"))["records"]


def loads(scene: str, way: str, *columns: str) -> list[str]:
    """Modeled ms of the adjoint on a card, its warps shared out in this way."""
    (row,) = (row for row in data("gpu_model")["loads"] if (row["scene"], row["warps of the adjoint"]) == (scene, way))
    return [two(float(row[column])) for column in columns or ("2 cycles", "4 cycles")]


def blend_gain() -> float:
    """Scalars against lanes, the forward pass on one thread."""
    found = data("blend")["seconds"]
    return found["scalar forward"] / found["lanes forward, 1 thread"]


def steps_slower(mode: str) -> float:
    """Time of a training step against that of ``manual``, the mean over the seeds."""
    rate = {
        name: mean(float(row["iterations_per_second"]) for row in rows("training") if row["variant"] == name)
        for name in (mode, "manual")
    }
    return rate["manual"] / rate[mode]


def looked_at(size: str, by: str = "looked_at") -> float:
    """Pixels that lanes look at, for each in which a Gaussian is blended; or "by_adjoint"."""
    found = data("step")[size]["counts"]
    return found[by] / found["pairs"]


def of_two_threads(limit: str) -> float:
    """What two threads do of one's "rate" or "bandwidth"."""
    limits = data("step")["limits"]
    return limits["2"][limit] / limits["1"][limit]


def images_gained() -> float:
    """Images per second of two processes against one of two threads."""
    found = {row[0]: float(row[6]) for row in data("parallel")["rows"]}
    return found["2 processes, as many images"] / found["1 process, 2 threads"]


#: Of cameras that find their way back: what it is called, and its unit in the one that is shown.
CAMERA_ERRORS = {"degrees": 1, "meters": 1e3, "share": 100}

#: How rows of the table of what is learned end, and what they are of.
LEARNED = {
    "with a rolling shutter the first row's": ("rotation", "translation"),
    "but panoramas: their size says them": ("focal", "principal"),
    "`affine` and `unscented`, every mode": ("coefficients",),
    "projection and mode, with a rolling shutter": ("last_rotation", "last_translation"),
}
