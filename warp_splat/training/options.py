"""The options of training, in groups, with units and sources. Standard library only: ``--help`` answers at once."""

import math
from dataclasses import dataclass, fields
from typing import Any, get_type_hints

from warp_splat.config import ADJOINTS, LAST_PORT, LENSES, LPIPS_HELP, PORT, PORT_HELP, PROJECTIONS
from warp_splat.errors import InputError
from warp_splat.flags import check_numbers, data, flag, flags_of, growing, learning, machinery, rendering, reporting
from warp_splat.training.growth import GROWTHS
from warp_splat.training.parts import AUTO, PARTS


@dataclass(frozen=True)
class DataOptions:
    """What is read."""

    source_path: str = flag("", "scene folder (COLMAP, nerf-synthetic, transforms.json); else the embedded one", "-s")
    sfm: bool = flag(False, "if the source is photographs or a video without cameras, run warp-splat sfm on them first")
    eval: bool = flag(False, "hold out every 8th image (by name) for testing")
    resolution: int = flag(-1, "1, 2, 4, 8: divide the size; other: width in px; -1: at most 1600 px", "-r", least=-1)
    preset: str = flag("", "fast: other defaults that train in minutes on a CPU; see docs", choices=("", "fast"))
    start_checkpoint: str = flag("", "a training to continue: folder or checkpoint; flags change options", "--resume")

    images: str = data("images", "folder of the photographs inside a COLMAP scene", "-i")
    white_background: bool = data(False, "composite on white instead of black", "-w")
    invert_masks: bool = data(False, "of the masks in masks/, the dark part counts, not the bright one")
    lens: str = data("undistort", "photographs with distortion: as pinholes would take them, or as is", choices=LENSES)
    loss_space: str = data("srgb", "the curve under which linear light (EXR, HDR) is compared", choices=("srgb", "log"))
    start_ply: str = data("", "Gaussians to start from instead of points: a file (.ply, .spz, ...) or a model folder")
    block: str = data("", "K/N: of the N blocks into which the scene is cut, train the K-th; see warp-splat merge")
    blocks: int = data(0, "train all of N blocks, one after another, merge them, and train once more with all together")
    config: str = data("", "options from a TOML file, such as a model's config.toml; flags take precedence")


@dataclass(frozen=True)
class ModelOptions:
    """What is learned, and how it is rendered."""

    sh_degree: int = rendering(3, "highest degree of the view-dependent color", choices=(0, 1, 2, 3))
    adjoint: str = rendering("manual", "how the pixel loop is differentiated", choices=ADJOINTS)
    projection: str = rendering("affine", "from 3D to 2D Gaussians", choices=PROJECTIONS)
    antialiasing: bool = rendering(False, "keep small Gaussians from growing brighter (Mip-Splatting)")
    parts: str = rendering("", f"what is done besides: {', '.join(PARTS)} (with commas), or auto: what a scene needs")


@dataclass(frozen=True)
class LearnOptions:
    """How it learns; the reference's names and defaults (its train.py of October 2024) where it has them."""

    iterations: int = flag(
        30_000,
        "images to train on, one in a step of each process; schedules count images",
        least=1,
        most=2**31 - 1,
        schedule=True,
    )
    views: int = learning(0, "images in a step, shared by all processes; 0: one for each process")
    minutes: float = flag(0.0, "instead of --iterations: plan a training that ends after so long, from its first step")

    lambda_dssim: float = learning(0.2, "share of 1 - SSIM in the loss", most=1)
    position_lr_init: float = learning(0.00016, "rate of the means at the start (times the scene's extent)")
    position_lr_final: float = learning(0.0000016, "rate of the means after position_lr_max_steps")
    position_lr_max_steps: int = learning(30_000, "steps over which the means' rate decays", least=1, schedule=True)
    feature_lr: float = learning(0.0025, "rate of the base color; the higher degrees learn 20 times slower")
    opacity_lr: float = learning(0.025, "rate of the opacity logits")
    scaling_lr: float = learning(0.005, "rate of the log scales")
    rotation_lr: float = learning(0.001, "rate of the quaternions")
    cooldown: int = learning(0, "over this many steps at the end, all rates fall to a tenth", schedule=True)
    settle_from_iter: int = learning(
        0, "from this step nothing grows, the cooldown runs, and training ends; 0: as --iterations says", schedule=True
    )
    sh_interval: int = learning(1000, "steps between two rises of the active SH degree", least=1, schedule=True)
    optimizer_type: str = learning(
        "default", "sparse_adam updates only what the image shows", choices=("default", "sparse_adam")
    )
    half_moments: bool = learning(False, "keep Adam's moments in 16 bits, rounded at random: less memory")
    coarse: int = learning(1, "start with images of this fraction of their size", choices=(1, 2, 4, 8))
    coarse_until_iter: int = learning(3000, "by this step the size has doubled to the full one", least=1, schedule=True)
    coarse_by: str = learning(
        "steps",
        "when it doubles: after as many steps each time, or by the share of the photographs' detail that a size shows",
        choices=("steps", "detail"),
    )
    seed: int = learning(0, "seed of everything random", most=2**63 - 1)

    @property
    def end(self) -> float:
        """The last step; infinite as long as a clock has to say it."""
        if self.settle_from_iter:
            return self.settle_from_iter + self.cooldown
        return math.inf if self.minutes else self.iterations

    @property
    def end_or_plan(self) -> int:
        """The last step, as far as one can tell."""
        return int(self.end) if self.end < math.inf else self.iterations

    def grows_at(self, iteration: int) -> bool:
        """Whether the set of Gaussians may still change."""
        return not self.settle_from_iter or iteration < self.settle_from_iter


@dataclass(frozen=True)
class GrowOptions:
    """How the set grows; each growth has options of its own."""

    max_gaussians: int = flag(0, "growth ends at this many; more points stay, unless --growth is budget; 0: no limit")

    growth: str = growing("reference", f"the rules: {', '.join(GROWTHS)}")


@dataclass(frozen=True)
class ReportOptions:
    """What is kept and told."""

    model_path: str = flag("", "output folder; default: output/<random name>", "-m")
    quiet: bool = flag(False, "print only the summary")

    test_iterations: list[int] = reporting([7_000, 30_000], "evaluate after these steps, and up to 20 times", many=int)
    save_iterations: list[int] = reporting([7_000, 30_000], "save the model after these steps, and the last", many=int)
    checkpoint_iterations: list[int] = reporting([], "keep a checkpoint of these steps, besides the last one", many=int)
    checkpoint_interval: float = reporting(5.0, "minutes between checkpoints (one stays); 0: only at start and end")
    lpips_weights: str = reporting("", LPIPS_HELP)
    tensorboard: bool = reporting(False, "also write event files for TensorBoard into the output folder")
    viewer: bool = reporting(False, "show the training in a browser, with pause and continue")
    port: int = reporting(PORT, PORT_HELP, least=1, most=LAST_PORT)
    verify: str = reporting("", "the sha256 that the model must have, or how it begins; exit code 1 if it has another")
    profile: int = reporting(0, "time the stages of the last N iterations, as a table and a plot")


@dataclass(frozen=True)
class MachineOptions:
    """Where it is computed."""

    device: str = machinery("auto", "where kernels run", choices=("auto", "cpu", "cuda"))
    data_device: str = machinery("cpu", "where the photographs are kept; cuda: if they fit", choices=("cpu", "cuda"))
    photo_memory: float = machinery(
        0.0, "GiB for photographs; others wait on the disk, or are decoded again; 0: a quarter of what is free"
    )
    threads: int = machinery(0, "CPU threads of a process; 0: all cores, or its share (results do not depend on it)")
    shard: bool = machinery(False, "each process that torchrun starts holds a share of the Gaussians, not all of them")
    out_of_core: bool = machinery(
        False, "keep the Gaussians in a file in the output folder, in memory what views show; with sparse_adam"
    )
    portable: bool = machinery(
        False, "multiply and add apart, as processors without fused multiply-adds do: slower, the same bytes there, too"
    )


@dataclass(frozen=True, init=False)
class TrainConfig:
    """Train Gaussians on a scene's photographs.

    Flags, files and ``TrainConfig(NAME=VALUE, ...)`` know all options by their names alone.
    """

    data: DataOptions
    model: ModelOptions
    learn: LearnOptions
    grow: GrowOptions
    report: ReportOptions
    machine: MachineOptions
    plugins: dict[str, Any]  # the options of every growth and part, by its name

    def __init__(self, **values: Any):
        made = {
            group: group(**{item.name: values.pop(item.name) for item in fields(group) if item.name in values})
            for group in self.groups()
        }
        if values:
            raise TypeError(f"TrainConfig: no such option: {', '.join(values)}")
        plugins = {name: made[entry.options] for name, entry in (GROWTHS | PARTS).items()}
        vars(self).update({name: made[group] for name, group in GROUPS.items()}, plugins=plugins)

    @staticmethod
    def groups() -> list[type]:
        """The type of each group, and of the options of each growth and part.

        Raises:
            InputError: if two of them have an option of one name: there is one flag for it.
        """
        found = list(dict.fromkeys([*GROUPS.values(), *(entry.options for entry in (GROWTHS | PARTS).values())]))
        owners: dict[str, type] = {}
        for group in found:
            for item in fields(group):
                if (owner := owners.setdefault(item.name, group)) is not group:
                    names = f"{owner.__name__} and {group.__name__}"
                    raise InputError(f"--{item.name}: expected one kind of options with it, found {names}; rename one.")
        return found

    @property
    def used_parts(self) -> list[str]:
        """The parts that are named, or that a flag of their own asks for, in the order in which they act."""
        named = self.model.parts.split(",")
        return [name for name in PARTS if name in named or getattr(self.plugins[name], name, False)]

    def flat(self) -> dict[str, Any]:
        """Every option by its name."""
        groups = [*(getattr(self, name) for name in GROUPS), *self.plugins.values()]
        return {name: value for group in groups for name, value in vars(group).items()}

    def changed(self, **values: Any) -> "TrainConfig":
        """The same but for these options."""
        return TrainConfig(**{**self.flat(), **values})


GROUPS = {name: kind for name, kind in get_type_hints(TrainConfig).items() if name != "plugins"}

#: What cannot change when a training is continued, and why.
FIXED_OPTIONS = {
    "sh_degree": "the number of coefficients of a Gaussian is that of its start",
    "optimizer_type": "the moments of one are not those of the other",
    "growth": "the statistics of one are not those of the other",
    "portable": "with it, kernels round otherwise",
    **dict.fromkeys(("antialiasing", "projection", "white_background"), "models saved before are drawn with it"),
    "block": "its Gaussians are those of its block",
    "start_ply": "it goes on from its own Gaussians",
    "seed": "random numbers continue from the checkpoint's",
    "preset": "other options are those of the checkpoint; name the ones to change",
    **dict.fromkeys(("exposure", "vignetting", "pose_intrinsics"), "what one has learned is nothing to the other"),
}
#: Of these, what cannot change only where a part has learned by it.
FIXED_BY_PARTS = {"exposure": "exposure", "vignetting": "exposure", "pose_intrinsics": "pose"}


def schedule_of(config: TrainConfig) -> dict[str, int]:
    """The steps of the schedule, by the names of their options: what ``--minutes`` plans."""
    values = config.flat()
    return {item.name: values[item.name] for item in flags_of(TrainConfig) if item.metadata["schedule"]}


def check_train(config: TrainConfig) -> None:
    """Raise InputError if a value of ``config`` cannot be."""
    check_numbers(config)
    learn, parts = config.learn, config.model.parts
    if (verify := config.report.verify) and (not 8 <= len(verify) <= 64 or set(verify) - set("0123456789abcdef")):
        raise InputError(
            f"--verify: expected 8 or more first digits of a sha256 as in results.json, got {verify!r:.80}."
        )
    if (config.data.block or config.data.blocks) and parts == AUTO:
        raise InputError(f"--block: expected parts by name, got --parts {AUTO}: each block would take others.")
    others = {"--resume": config.data.start_checkpoint, "--block": config.data.block, "--minutes": learn.minutes}
    for name in filter(others.get, others if config.data.blocks else ()):
        raise InputError(f"--blocks: expected no {name} beside it; leave one of them out.")
    if learn.position_lr_init <= 0 or learn.position_lr_final <= 0:
        raise InputError("--position_lr_init, --position_lr_final: expected more than 0, for rates to decay between.")
    if config.grow.growth not in GROWTHS:
        raise InputError(f"--growth: expected one of {', '.join(GROWTHS)}, got {config.grow.growth!r:.50}.")
    if unknown := set(parts.split(",")) - {*PARTS} if parts and parts != AUTO else ():
        some = f"expected {AUTO}, or some of {', '.join(PARTS)} between commas"
        raise InputError(f"--parts: {some}, got {min(unknown)!r:.50}.")
