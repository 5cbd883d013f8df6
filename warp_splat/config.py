"""Everything that can be chosen, with units and sources. Standard library only, so that ``--help`` answers at once."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields

from warp_splat.flags import argument, data, film, flag, growing, learning, machinery, rendering, reporting

# The renderer's constants (those of the reference implementation, Kerbl et al. 2023).
ALPHA_MIN = 1.0 / 255.0  # a Gaussian weaker than this at a pixel is skipped there
ALPHA_MAX = 0.99  # alpha is clamped so that 1 / (1 - alpha) stays bounded
T_MIN = 1.0e-4  # a pixel stops before the Gaussian that would take its transmittance below this
T_LEAST = 1.0e-30  # no threshold is lower: a transmittance that underflows could not be recovered by division
NEAR = 0.2  # world units along the optical axis; Gaussians whose centre is nearer are culled
BLUR = 0.3  # px^2, added to both variances of the projected Gaussian (low-pass)
OUTLINE = 2.0  # standard deviations of the ellipsoid whose outline the projection "ellipsoid" takes
OUTLINE_REACH = 3.0  # it leaves out a Gaussian of which this many standard deviations reach the plane of the camera
COMPENSATION_MIN = 2.5e-5  # floor of the share of its area that antialiasing leaves a Gaussian, squared
FRUSTUM_MARGIN = 0.3  # x/z in the Jacobian is clamped this share of the half field of view outside the image
TILE = 16  # px, side of a tile

PORT = 8080  # of the viewer
PORT_HELP = "of the viewer; if it is busy, the next free one"

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)  # that we may use

ADJOINTS = ("manual", "stepwise", "reversible", "stored")  # of the pixel loop; see warp_splat.rasterize
PROJECTIONS = ("affine", "ellipsoid")  # see RasterOptions, as for all that follow
EXTENTS = ("ellipse", "square")
LOSS_SPACES = ("srgb", "log")
EXP_DEGREES = (3, 4, 5, 6, None)
VIDEOS = ("orbit", "spiral", "path")  # see warp_splat.rendering.camera_paths

LPIPS_HELP = "also measure LPIPS: torchvision's weights of VGG16 or AlexNet, a .pth file; needs the package lpips"


@dataclass(frozen=True)
class RasterOptions:
    """What the renderer is asked for; what is not asked for is not computed.

    Args:
        depth: also return the expected depth per pixel.
        sh_degree: highest spherical-harmonics degree to evaluate (0 to 3); None evaluates all that ``sh`` holds.
        antialiasing: scale each opacity by the share of its area that the low-pass filter added (Mip-Splatting, Yu
            et al. 2024), so that small Gaussians do not grow brighter; by no less than 0.005, as in the reference.
        projection: "affine" (EWA splatting, Zwicker et al. 2001: linearized at the mean) or "ellipsoid" (the exact
            outline of an ellipsoid instead of the Gaussian; Qi, Cai and Han 2024).
        alpha_min: a Gaussian is skipped at pixels where its opacity is below this, 0 to 1; 0 skips nothing.
        t_min: a pixel stops before the Gaussian that would take its transmittance below this, 0 to 1; 0 means 1e-30.
        max_steps: entries of a tile's list that are looked at, nearest first; None: all of them.
        extent: which tiles list a Gaussian: "ellipse" (exactly those where its opacity reaches ``alpha_min``) or
            "square" (of the reference: 3 standard deviations of the long axis).
        exp_degree: degree of the polynomial in the exponential, 3 to 6; None calls the C library's, without lanes.
    """

    depth: bool = False
    sh_degree: int | None = None
    antialiasing: bool = False
    projection: str = "affine"
    alpha_min: float = ALPHA_MIN
    t_min: float = T_MIN
    max_steps: int | None = None
    extent: str = "ellipse"
    exp_degree: int | None = 5


@dataclass
class TrainConfig:
    """Training options; the reference's names and defaults (its train.py of October 2024) where it has them."""

    source_path: str = flag(
        "", "scene folder (COLMAP, nerf-synthetic, transforms.json); without it, the embedded scene", "-s"
    )
    model_path: str = flag("", "output folder; default: output/<random name>", "-m")
    sfm: bool = flag(False, "if the source is photographs or a video without cameras, run warp-splat sfm on them first")
    eval: bool = flag(False, "hold out every 8th image (by name) for testing")
    resolution: int = flag(-1, "1, 2, 4, 8: divide the size; other: width in px; -1: at most 1600 px wide", "-r")
    preset: str = flag("", "fast: other defaults that train in minutes on a CPU; see docs", choices=("", "fast"))
    iterations: int = flag(
        30_000,
        "images to train on, one in each step; n in each under torchrun with n processes; schedules count images",
    )
    max_gaussians: int = flag(0, "never grow beyond this many (largest gradients first); 0: no limit")
    start_checkpoint: str = flag(
        "", "continue a training: its folder, or a checkpoint; options are the same but for those given", "--resume"
    )
    quiet: bool = flag(False, "print only the summary")

    images: str = data("images", "folder of the photographs inside a COLMAP scene", "-i")
    white_background: bool = data(False, "composite on white instead of black", "-w")
    invert_masks: bool = data(False, "of the masks in masks/, the dark part counts, not the bright one")
    loss_space: str = data(
        "srgb", "photographs in linear light (EXR, HDR): the curve under which they are compared", choices=LOSS_SPACES
    )
    start_ply: str = data("", "a file of Gaussians to start from instead of the scene's points (.ply, .spz, ...)")
    config: str = data("", "options from a TOML file, such as a model's config.toml; flags that are given go before")

    sh_degree: int = rendering(3, "highest degree of the view-dependent color", choices=(0, 1, 2, 3))
    adjoint: str = rendering("manual", "how the pixel loop is differentiated", choices=ADJOINTS)
    projection: str = rendering("affine", "from 3D to 2D Gaussians", choices=PROJECTIONS)
    antialiasing: bool = rendering(False, "keep small Gaussians from growing brighter (Mip-Splatting)")
    random_background: bool = rendering(False, "a random background color in every step")

    lambda_dssim: float = learning(0.2, "share of 1 - SSIM in the loss")
    position_lr_init: float = learning(0.00016, "rate of the means at the start (times the scene's extent)")
    position_lr_final: float = learning(0.0000016, "rate of the means after position_lr_max_steps")
    position_lr_max_steps: int = learning(30_000, "steps over which the means' rate decays")
    feature_lr: float = learning(0.0025, "rate of the base color; the higher degrees learn 20 times slower")
    opacity_lr: float = learning(0.025, "rate of the opacity logits")
    scaling_lr: float = learning(0.005, "rate of the log scales")
    rotation_lr: float = learning(0.001, "rate of the quaternions")
    cooldown: int = learning(0, "over so many steps at the end, all rates fall to a tenth")
    sh_interval: int = learning(1000, "steps between two rises of the active SH degree")
    optimizer_type: str = learning(
        "default", "sparse_adam updates only what the image shows", choices=("default", "sparse_adam")
    )
    coarse: int = learning(1, "start with images of this fraction of their size", choices=(1, 2, 4, 8))
    coarse_until_iter: int = learning(3000, "by this step the size has doubled, at equal intervals, to the full one")
    seed: int = learning(0, "seed of everything random")

    densify_from_iter: int = growing(500, "first step of densification")
    densify_until_iter: int = growing(15_000, "last step of densification")
    densification_interval: int = growing(100, "steps between two densifications")
    densify_grad_threshold: float = growing(0.0002, "mean gradient of the 2D mean (NDC units) above which to densify")
    percent_dense: float = growing(
        0.01, "share of the scene's extent above which a Gaussian splits instead of being cloned"
    )
    opacity_reset_interval: int = growing(3000, "steps between two resets of all opacities to 0.01")
    prune_screen_size: int = growing(
        0, "prune Gaussians wider than this radius in px in any view; 0: never, which is what the reference's 20 does"
    )

    test_iterations: list[int] = reporting([7_000, 30_000], "evaluate after these steps, and 20 times in all", many=int)
    save_iterations: list[int] = reporting([7_000, 30_000], "save the model after these steps, and the last", many=int)
    checkpoint_iterations: list[int] = reporting([], "keep a checkpoint of these steps, besides the last one", many=int)
    checkpoint_interval: float = reporting(
        5.0, "minutes between two checkpoints, of which the last is kept; 0: one at the start and one at the end"
    )
    lpips_weights: str = reporting("", LPIPS_HELP)
    tensorboard: bool = reporting(False, "also write event files for TensorBoard into the output folder")
    viewer: bool = reporting(False, "show the training in a browser, with pause and continue")
    port: int = reporting(PORT, PORT_HELP)
    profile: int = reporting(0, "time the stages of the last N iterations, as a table and a plot")

    device: str = machinery("auto", "where kernels run", choices=("auto", "cpu", "cuda"))
    data_device: str = machinery("cpu", "where the photographs are kept; cuda: if they fit", choices=("cpu", "cuda"))
    threads: int = machinery(
        0, "CPU threads of a process; 0: all cores, or under torchrun its share (results do not depend on it)"
    )


#: What cannot change when a training is continued, and why.
FIXED_OPTIONS = {
    "sh_degree": "the number of coefficients of a Gaussian is that of its start",
    "optimizer_type": "the moments of one are not those of the other",
    "seed": "random numbers continue from the checkpoint's",
    "preset": "other options are those of the checkpoint; name the ones to change",
}


@dataclass
class RenderConfig:
    """Rendering options; the reference's render.py where it has them."""

    model_path: str = flag("", "folder of a trained model, or a file of Gaussians (.ply, .splat, .spz, .glb)", "-m")
    source_path: str = flag("", "scene folder, if it has moved since training; a file of Gaussians needs one", "-s")
    iteration: int = flag(-1, "which saved model; -1: the last")
    skip_train: bool = flag(False, "no images of the training views")
    skip_test: bool = flag(False, "no images of the test views")
    video: str = flag(
        "",
        "a video instead of the views: around what the cameras look at (orbit), a spiral before it, or along the "
        "cameras of training (path)",
        choices=("", *VIDEOS),
    )
    quiet: bool = flag(False, "print only the summary")

    frames: int = film(250, "frames of the video, 25 a second")
    video_output: str = film(
        "",
        "where to keep the frames: an .mp4 file, or a folder for PNG files; default: <model>/<video>.mp4",
        "--orbit_output",
    )
    orbit: bool = film(False, "time an orbit of 100 frames at 980 x 545; kept only if --orbit_output says where")
    orbit_center: str = film(
        "",
        "what an orbit goes around: the world's origin (default of --orbit), or the point that the cameras look at "
        "(default of --video)",
        choices=("", "origin", "focus"),
    )

    lpips_weights: str = reporting("", LPIPS_HELP)

    device: str = machinery("auto", "where kernels run", choices=("auto", "cpu", "cuda"))
    threads: int = machinery(0, "CPU threads; 0: all cores (results do not depend on it)")


@dataclass
class ViewConfig:
    """A model to look at in a browser."""

    model: str = argument("folder of a trained model, or a file of Gaussians (.ply, .splat, .spz, .glb)")
    source_path: str = flag("", "scene folder, for its photographs; default: the one of the training", "-s")
    iteration: int = flag(-1, "which saved model; -1: the last")
    port: int = flag(PORT, PORT_HELP)
    device: str = flag("auto", "where kernels run", choices=("auto", "cpu", "cuda"))
    threads: int = flag(0, "CPU threads; 0: all cores")


@dataclass
class SfmConfig:
    """From photographs to a scene: structure from motion."""

    photos: str = argument("folder of photographs, or a video")
    scene: str = argument("the folder to write: images/ without distortion, sparse/0, and the work in sfm/")
    frames: int = flag(150, "how many frames to take from a video: the sharpest of each of so many equal spans")
    matching: str = flag(
        "auto",
        "which photographs to compare: exhaustive, all pairs; sequential, neighbors by name; auto: sequential for more "
        "than 200 frames of a video",
        choices=("auto", "exhaustive", "sequential"),
    )
    threads: int = flag(0, "CPU threads; 0: all cores")
    seed: int = flag(0, "seed of everything random")
    quiet: bool = flag(False, "print only the summary")


@dataclass
class InspectConfig:
    """A scene to examine before anyone trains on it."""

    scene: str = argument("scene folder (COLMAP, nerf-synthetic or transforms.json)")
    images: str = flag("images", "folder of the photographs inside a COLMAP scene", "-i")
    out: str = flag("", "the page to write; default: output/inspect/<name of the scene>.html", "-o")


@dataclass
class ConvertConfig:
    """A model and a file of Gaussians: .ply, .splat, .spz, .glb or .gltf."""

    source: str = argument("the file to read, or the folder of a trained model")
    target: str = argument("the file to write; its ending says in which format")


@dataclass
class ExportHtmlConfig:
    """A model as a page that shows it."""

    model: str = argument("the folder of a trained model, or a file of Gaussians (.ply, .splat, .spz, .glb)")
    page: str = argument("the page to write, *.html")
    max_gaussians: int = flag(0, "keep only so many, by opacity and size; 0: all that can be seen")


@dataclass
class CompareConfig:
    """Options of the comparison; without ``--stability`` or ``--volume``: adjoints, knobs and training."""

    scene: str = flag("", "scene (COLMAP, nerf-synthetic, transforms.json) to measure on, besides our own", "-s")
    out: str = flag("output/compare", "folder for tables (CSV, JSON) and plots", "-o")
    modes: list[str] = flag(list(ADJOINTS), "adjoints to compare", many=str)
    stability: bool = flag(False, "the catalogue of stiff and extreme cases instead")
    volume: bool = flag(False, "the physics underneath instead: quadratures, and what splatting approximates")
    full: bool = flag(False, "train by the whole schedule instead of 300 steps")
    device: str = flag("auto", "where kernels run", choices=("auto", "cpu", "cuda"))
    threads: int = flag(0, "CPU threads; 0: all cores")


def check_train(config: TrainConfig) -> str | None:
    """What is wrong with the values of ``config``, in one sentence, or None."""
    at_least = {
        "iterations": 1,
        "threads": 0,
        "profile": 0,
        "max_gaussians": 0,
        "prune_screen_size": 0,
        "position_lr_max_steps": 1,
        "densification_interval": 1,
        "opacity_reset_interval": 1,
        "sh_interval": 1,
        "coarse_until_iter": 1,
        "cooldown": 0,
    }
    for name, low in at_least.items():
        if getattr(config, name) < low:
            return f"--{name}: expected at least {low}, got {getattr(config, name)}."
    for name in ("test_iterations", "save_iterations", "checkpoint_iterations"):
        if min(getattr(config, name), default=1) < 1:
            return f"--{name}: expected numbers of steps, at least 1, got {min(getattr(config, name))}."
    if not 1 <= config.port <= 65535:
        return f"--port: expected 1 to 65535, got {config.port}."
    if not 0 <= config.seed < 2**63:
        return f"--seed: expected 0 to 2^63 - 1, got {config.seed}."
    for item in fields(config):
        value = getattr(config, item.name)
        if isinstance(value, float) and not 0 <= value < float("inf"):
            return f"--{item.name}: expected a finite number, at least 0, got {value}."
    if config.lambda_dssim > 1:
        return f"--lambda_dssim: expected 0 to 1, got {config.lambda_dssim}."
    if config.position_lr_init <= 0 or config.position_lr_final <= 0:
        return "--position_lr_init, --position_lr_final: expected more than 0 (the rate decays from one to the other)."
    return None
