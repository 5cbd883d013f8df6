"""What is learned or done besides the Gaussians: the options of each part, and the table. Standard library only."""

from dataclasses import dataclass

from warp_splat.flags import learning, rendering
from warp_splat.training.seams import Entry

EXPOSURES = ("gain", "affine", "bilateral")
AUTO = "auto"  # in --parts: those that the scene needs


@dataclass(frozen=True)
class BackgroundOptions:
    """A random background."""

    random_background: bool = rendering(False, "a random background color in every step")


@dataclass(frozen=True)
class SkyOptions:
    """What is beyond everything."""

    sky_lr: float = learning(0.01, "rate of the colors of --parts sky at its start")


@dataclass(frozen=True)
class FloatersOptions:
    """A price on opacity."""

    opacity_reg: float = learning(0.05, "weight of the mean opacity in the loss of --parts floaters")


@dataclass(frozen=True)
class ExposureOptions:
    """Exposure and white balance of each photograph."""

    exposure: str = learning(
        "", "colors of each photograph, learned: asks for the part; of --parts: gain", choices=("", *EXPOSURES)
    )
    exposure_lr_init: float = learning(0.01, "rate of exposure at the start, of values from 0 to 1")
    exposure_lr_final: float = learning(0.0001, "rate of exposure at the end")
    exposure_reg: float = learning(0.01, "weight of the squared difference of a photograph's map to the identity")
    vignetting: bool = learning(False, "exposure also learns how all photographs darken towards their corners")


@dataclass(frozen=True)
class PoseOptions:
    """Poses and lenses that are learned."""

    pose_lr: float = learning(0.0005, "rate of --parts pose at its start, in shares of the pictures' width")
    pose_from_iter: int = learning(0, "step from which poses move", schedule=True)
    pose_reg: float = learning(0.1, "weight of the squared distance from the given poses and lenses in the loss")
    pose_intrinsics: str = learning("", "what of the lens --parts pose refines, too", choices=("", "focal", "all"))


@dataclass(frozen=True)
class DepthOptions:
    """Depths that are known."""

    depths: str = learning("", "folder in the scene with maps of inverse depth, .png or .exr: asks for depth", "-d")
    depth_l1_weight_init: float = learning(1.0, "weight of known depths in the loss at the start")
    depth_l1_weight_final: float = learning(0.01, "weight of known depths at the end")

    @property
    def depth(self) -> bool:
        """Whether a flag asks for the part."""
        return bool(self.depths)


@dataclass(frozen=True)
class SurfaceOptions:
    """A truer surface."""

    surface_normals: float = learning(0.01, "weight in the loss of --parts surface: of normals unlike those of depths")
    surface_views: float = learning(0.5, "weight in the loss of --parts surface: of depths unlike those of other views")


#: In this order they act in each step. A flag with the name of its part asks for it as ``--parts`` does.
PARTS: dict[str, Entry] = {
    "random_background": Entry(BackgroundOptions, "warp_splat.training.parts.background.RandomBackground"),
    "sky": Entry(SkyOptions, "warp_splat.training.parts.sky.Sky"),
    "exposure": Entry(ExposureOptions, "warp_splat.training.parts.exposure.Exposure"),
    "pose": Entry(PoseOptions, "warp_splat.training.parts.pose.Pose"),
    "depth": Entry(DepthOptions, "warp_splat.training.parts.depth.Depth"),
    "surface": Entry(SurfaceOptions, "warp_splat.training.parts.surface.SurfacePart"),
    "floaters": Entry(FloatersOptions, "warp_splat.training.parts.floaters.Floaters"),
}
