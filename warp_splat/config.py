"""What can be chosen, with units and sources (of training: in training/options.py).

Standard library only, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

from warp_splat.flags import argument, film, flag, machinery, reporting

if TYPE_CHECKING:
    import torch

    from warp_splat.kernels.falloff import Falloff
    from warp_splat.kernels.project import Projection

# The renderer's constants (those of the reference implementation, Kerbl et al. 2023).
ALPHA_MIN = 1.0 / 255.0  # a Gaussian weaker than this at a pixel is skipped there
ALPHA_MAX = 0.99  # alpha is clamped so that 1 / (1 - alpha) stays bounded
T_MIN = 1.0e-4  # a pixel stops before the Gaussian that would take its transmittance below this
T_LEAST = 1.0e-30  # no threshold is lower: a transmittance that underflows could not be recovered by division
NEAR = 0.2  # world units along the optical axis; Gaussians whose center is nearer are culled
BLUR = 0.3  # px^2, added to both variances of the projected Gaussian (low-pass)
OUTLINE = 2.0  # standard deviations of the ellipsoid whose outline the projection "ellipsoid" takes
OUTLINE_REACH = 3.0  # it leaves out a Gaussian of which this many standard deviations reach the plane of the camera
COMPENSATION_MIN = 2.5e-5  # floor of the share of its area that antialiasing leaves a Gaussian, squared
FRUSTUM_MARGIN = 0.3  # x/z in the Jacobian is clamped this share of the half field of view outside the image
TILE = 16  # px, side of a tile
CHANNELS_MOST = 512  # of features
STRONGEST_MOST = 8  # Gaussians of a pixel that are told

PORT, LAST_PORT = 8080, 65535  # of the viewer
CROP_HELP = "keep Gaussians with their center in this box: smallest x y z, then largest [world units]"
PORT_HELP = "of the viewer; if it is busy, the next free one"
TOLERANCE_HELP = "leave out what changes no pixel by more, of 1; 0: the usual cuts"

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)  # that we may use

ADJOINTS = ("manual", "stepwise", "reversible", "stored")  # of the pixel loop; see warp_splat.rasterize
PROJECTIONS = ("affine", "ellipsoid", "unscented")  # files of kernels/project; see RasterOptions, as all that follow
EXTENTS = ("ellipse", "square")
BOUNDS_OF = ("ideal", "trained")
EXP_DEGREES = (3, 4, 5, 6, None)
LENSES = ("undistort", "native")  # what becomes of photographs with distortion; see load_scene
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
            outline of an ellipsoid instead of the Gaussian; Qi, Cai and Han 2024; not of a camera with a lens) or
            "unscented" (seven points through the lens; Wu et al. 2025), or your own; see docs/extending.md.
        alpha_min: a Gaussian is skipped at pixels where its opacity is below this, 0 to 1; 0 skips
            none but those of opacity 0.
        alpha_max: an opacity at a pixel is clamped to this, 0 to 0.9999.
        t_min: a pixel stops before the Gaussian that would take its transmittance below this, 0 to 1; 0 means 1e-30.
        max_steps: entries of a tile's list that are looked at, nearest first; None: all of them.
        extent: which tiles list a Gaussian: "ellipse" (exactly those where its opacity reaches ``alpha_min``) or
            "square" (of the reference: 3 standard deviations of the long axis). A CPU also leaves out the blocks of
            4 x 4 pixels outside of that square, where alpha may still be 0.011; a GPU draws them.
        exp_degree: degree of the polynomial in the exponential, 3 to 6; None calls the C library's, without lanes. On a
            GPU its own instruction, with an error of 2.4e-7, stands for 3 to 5.
        falloff: of your own instead of the Gaussian's, see :class:`warp_splat.Falloff`; not with adjoint "manual".
        median_depth: also return the depth per pixel at which half of the light is gone.
        normals: also blend the Gaussians' normals, their shortest axes towards the camera, and how far from the camera
            the planes across them are.
        strongest: also return which Gaussians weigh most in each pixel, so many of them, 0 to 8, and their weights.
        near: Gaussians whose center is nearer along the optical axis (of a wide lens: nearer) are left out, at least
            1e-6 [world units].
        blur: added to both variances of the projected Gaussian (low-pass), at least 1e-6 [px^2].
        bound: also return how far a pixel can be from the ideal: the same Gaussians in the same order without any cut,
            in real arithmetic (docs/tolerance.md). The background must not be negative.
        of: what the bound is of: "ideal", or "trained": what is below 1/255 at a pixel is not part of the model, since
            the reference's rules left it out in training.
        tolerance: cut as much as the bound allows, which is then found, too: a number, or one for each pixel [H, W],
            above 0. Takes the place of ``alpha_min`` and ``t_min``, and lowers ``exp_degree``. Rounding comes on top.
        hidden_from: depth of an opaque surface, [H, W] float32: a Gaussian whose center is as far or farther is hidden
            by it. Where it is not positive, there is no surface. Not with ``bound`` or ``tolerance``.
    """

    depth: bool = False
    sh_degree: int | None = None
    antialiasing: bool = False
    projection: str | Projection = "affine"
    alpha_min: float = ALPHA_MIN
    alpha_max: float = ALPHA_MAX
    t_min: float = T_MIN
    max_steps: int | None = None
    extent: str = "ellipse"
    exp_degree: int | None = 5
    falloff: Falloff | None = None
    median_depth: bool = False
    normals: bool = False
    strongest: int = 0
    near: float = NEAR
    blur: float = BLUR
    bound: bool = False
    of: str = "ideal"
    tolerance: float | torch.Tensor | None = None
    hidden_from: torch.Tensor | None = None


@dataclass(kw_only=True)
class OnDevice:
    """Where it is computed."""

    device: str = machinery("auto", "where kernels run", choices=("auto", "cpu", "cuda"))
    threads: int = machinery(0, "CPU threads; 0: all cores (results do not depend on it)")


@dataclass
class FinishedModel(OnDevice):
    """A model, and the scene that it was trained on."""

    model: str = argument("the folder of a trained model, or a file of Gaussians (.ply, .spz, .sog, .glb, ...)")
    source_path: str = flag("", "scene folder, for its photographs; default: the one of the training", "-s")
    iteration: int = flag(-1, "which saved model; -1: the last", least=-1)
    crop: list[float] = flag([], CROP_HELP, many=float)


@dataclass
class RenderConfig(OnDevice):
    """Render a model: its views with metrics, or a video."""

    model_path: str = flag("", "folder of a trained model, or a file of Gaussians (.ply, .spz, .sog, .glb, ...)", "-m")
    source_path: str = flag("", "scene folder, if it has moved since training; a file of Gaussians needs one", "-s")
    iteration: int = flag(-1, "which saved model; -1: the last", least=-1)
    skip_train: bool = flag(False, "no images of the training views")
    skip_test: bool = flag(False, "no images of the test views")
    video: str = flag(
        "",
        "a video instead of the views: around what the cameras look at (orbit), a spiral before it, or along the "
        "cameras of training (path)",
        choices=("", *VIDEOS),
    )
    quiet: bool = flag(False, "print only the summary")
    tolerance: float = flag(0.0, TOLERANCE_HELP, most=1)
    of: str = flag("trained", "what a tolerance and a bound compare with: see docs/tolerance.md", choices=BOUNDS_OF)
    bound: bool = flag(
        False,
        "also write how wrong each pixel may be, and what another order may change: pictures with a scale, EXR files",
    )

    frames: int = film(250, "frames of the video, 25 a second", least=1)
    video_output: str = film("", "an .mp4 file, or a folder for PNG; default: <model>/<video>.mp4", "--orbit_output")
    orbit: bool = film(False, "time an orbit of 100 frames at 980 x 545; kept only if --orbit_output says where")
    orbit_center: str = film(
        "",
        "what an orbit goes around: the world's origin (default of --orbit), or the point that the cameras look at "
        "(default of --video)",
        choices=("", "origin", "focus"),
    )

    lpips_weights: str = reporting("", LPIPS_HELP)


@dataclass
class ViewConfig(FinishedModel):
    """Look at a trained model in a browser."""

    tolerance: float = flag(0.0, TOLERANCE_HELP, most=1)
    port: int = flag(PORT, PORT_HELP, least=1, most=LAST_PORT)


@dataclass
class SfmConfig:
    """Compute the cameras of photographs or of a video: a scene to train on."""

    photos: str = argument("folder of photographs, or a video")
    scene: str = argument("the folder to write: images/ without distortion, sparse/0, and the work in sfm/")
    keep_lens: bool = flag(False, "images/ as they are, with their lenses, for train --lens native")
    frames: int = flag(150, "frames to take from a video: the sharpest of each of as many equal spans", least=3)
    matching: str = flag(
        "auto",
        "which photographs to compare: exhaustive, all pairs; looks, those that look alike, and what fits to both; "
        "sequential, neighbors by name; auto: looks from 100 photographs on",
        choices=("auto", "exhaustive", "looks", "sequential"),
    )
    coordinates: str = flag(
        "auto",
        "scale, up and origin: auto, from GPS in the photographs if they have it; none; or a CSV file whose first line "
        "is name,x,y,z (cameras in meters: east, north, up) or name,other,distance",
    )
    threads: int = flag(0, "CPU threads; 0: all cores")
    seed: int = flag(0, "seed of everything random", most=2**31 - 1)
    quiet: bool = flag(False, "print only the summary")


@dataclass
class InspectConfig:
    """Examine a scene before training: verdicts and pictures."""

    scene: str = argument("scene folder (COLMAP, nerf-synthetic or transforms.json)")
    images: str = flag("images", "folder of the photographs inside a COLMAP scene", "-i")
    out: str = flag("", "the page to write; default: output/inspect/<name of the scene>.html", "-o")


@dataclass
class ConvertConfig:
    """Convert Gaussians between .ply, .splat, .spz, .sog, glTF, USD."""

    source: str = argument("the file to read, or the folder of a trained model")
    target: str = argument("the file to write; its ending says in which format")
    crop: list[float] = flag([], CROP_HELP, many=float)
    bound: bool = flag(False, "also print how much pictures from around change, measured and with a bound")


@dataclass
class MergeConfig:
    """Make one model of the blocks of a scene (train --block)."""

    folder: str = argument("the folder in which the folders of their trainings are; the model is written here")


@dataclass
class SimplifyConfig(FinishedModel):
    """Leave out what a finished model does not need."""

    keep: float = flag(0.0, "the share of the Gaussians to keep", most=1)
    max_loss: float = flag(0.0, "or: keep as few as cost at most this much PSNR of the training views, in dB")
    size: str = flag("", "or: keep as many as fit into a file of this size, such as 10MB")
    tolerance: float = flag(0.0, "or: keep as few as change no pixel of a training view by more, of 1", most=1)
    steps: int = flag(0, "steps of training that make up for what was left out (300 are enough)")
    output: str = flag("", "the file to write, of any format; default: simplified.ply in the model's folder", "-o")


@dataclass
class CleanConfig(FinishedModel):
    """Leave out what hangs right before few cameras."""

    views: float = flag(3.0, "a floater is carried by fewer training views than this")
    near: float = flag(0.5, "and nearer to them than this share of the depth of half of what they show")
    steps: int = flag(0, "steps of training after leaving them out, with a price on opacity (--parts floaters)")
    output: str = flag("", "the file to write, of any format; default: cleaned.ply in the model's folder", "-o")


@dataclass
class MeshConfig(FinishedModel):
    """Write the surface of a trained model as triangles."""

    output: str = argument("the mesh to write, *.glb, *.ply or *.obj")
    voxel: float = flag(0.0, "edge of a voxel [world units]; 0: two pixels at their median depth")
    memory: float = flag(0.0, "views and voxels take at most so many GB; 0: a quarter of what is free")
    triangles: int = flag(0, "simplify to so many; 0: all")
    watertight: bool = flag(False, "close all holes, so that it has an inside")
    collision: int = flag(0, "also write at most so many convex pieces around it, for simulators", most=10**6)


@dataclass
class ExportHtmlConfig:
    """Write a page that shows a model anywhere."""

    model: str = argument("the folder of a trained model, or a file of Gaussians (.ply, .spz, .sog, .glb, ...)")
    page: str = argument("the page to write, *.html")
    crop: list[float] = flag([], CROP_HELP, many=float)
    max_gaussians: int = flag(0, "keep only this many, by opacity and size; 0: all that can be seen")


@dataclass
class CompareConfig(OnDevice):
    """Compare adjoints: error against run time and memory."""

    scene: str = flag("", "scene (COLMAP, nerf-synthetic, transforms.json) to measure on, besides our own", "-s")
    out: str = flag("output/compare", "folder for tables (CSV, JSON) and plots", "-o")
    modes: list[str] = flag(list(ADJOINTS), "adjoints to compare", many=str)
    stability: bool = flag(False, "the catalog of stiff and extreme cases instead")


@dataclass
class AuditConfig:
    """Measure any renderer of Gaussians against float64."""

    target: str = argument("MODULE:function, a page that ends in .html, or with --command any name")
    program: str = flag(
        "", "a program instead: 'prog {ply} {cameras} {out}' writes a PNG; {exr} and {background} too", "--command"
    )
    case: str = flag("", "only this scene, made as small as still shows what is wrong with it")
    out: str = flag("output/audit", "folder for audit.json and audit.html, or for the files of --case", "-o")
    degree: int = flag(3, "of harmonics, the highest that the renderer claims", most=3)
    limit: float = flag(60.0, "seconds for a picture, after which it counts as hanging", least=0.1)
