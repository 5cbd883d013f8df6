"""One training step after another: sample a view, render, compare, adapt. No files, no printing."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from warp_splat.camera import Camera
from warp_splat.color import to_bytes
from warp_splat.config import TILE, RasterOptions
from warp_splat.errors import InputError
from warp_splat.evaluation.alignment import where_taken
from warp_splat.evaluation.metrics import psnr
from warp_splat.formats.checkpoint import Checkpoint
from warp_splat.formats.curve import along_curve
from warp_splat.formats.exposures import Exposures
from warp_splat.formats.model_folder import prepare_folder
from warp_splat.formats.splats import COEFFICIENTS
from warp_splat.gaussians import CHUNK, GaussianModel
from warp_splat.kernels.project.quarantine import quarantine
from warp_splat.raster.api import RenderOutput, render
from warp_splat.raster.camera_parameters import CameraParameters
from warp_splat.raster.data import Gaussians, Room, Splats2D
from warp_splat.raster.project import project
from warp_splat.rendering.finished import as_photographed
from warp_splat.runtime.devices import choose_device
from warp_splat.runtime.distributed import ALONE, Processes
from warp_splat.runtime.launch import load
from warp_splat.runtime.shards import Shards
from warp_splat.runtime.timers import stage
from warp_splat.scene.decoding import AHEAD, in_turn
from warp_splat.scene.types import Scene, View
from warp_splat.training.growth import GROWTHS
from warp_splat.training.loss import LOSS_CURVES, image_loss
from warp_splat.training.optimizer import Optimizer
from warp_splat.training.options import TrainConfig
from warp_splat.training.parts import AUTO, PARTS
from warp_splat.training.photographs import Deck, Photographs
from warp_splat.training.seams import Setting, Step, having
from warp_splat.training.sharded import Blocks, Observed

T = TypeVar("T")
#: What is kept from spreading because it is not finite: pixels with an upstream gradient that is not; gradients of
#: Gaussians, which are not updated in that step; Gaussians with a parameter that is not, once for each image.
NOT_FINITE = ("pixels", "gradients", "gaussians")


class Trainer:
    """The reference's training (Kerbl et al. 2023) on one scene.

    Args:
        scene: views and points.
        config: options.
        processes: those that train together; each takes a view of its own in every step.

    Raises:
        InputError: if the device cannot be used, there are more processes than training views, or options do not fit
            the scene.
    """

    def __init__(self, scene: Scene, config: TrainConfig, processes: Processes = ALONE):
        if processes.images > len(scene.train):
            flags = "--views" if config.learn.views else "--nproc-per-node"
            raise InputError(
                f"{flags}: expected at most an image a step for each of {len(scene.train)} training views, got "
                f"{processes.images}; take fewer."
            )
        if config.data.loss_space != "srgb" and not scene.linear:
            raise InputError(
                f"--loss_space {config.data.loss_space}: expected photographs in linear light (EXR, HDR, TIFF of "
                f"floats), found {scene.train[0].name}, which is as a screen shows it; leave this flag out."
            )
        if config.model.parts == AUTO:
            raise InputError("--parts auto: expected names of parts here; trial.settle_parts chooses them.")
        self.scene, self.config, self.device = scene, config, choose_device(config.machine.device)
        self.processes = processes
        means, degree = (scene.start.splats.means if scene.start else scene.points), config.model.sh_degree
        own = along_curve(torch.from_numpy(means).float())[processes.own(len(means))].numpy()
        if scene.start:
            model = GaussianModel.from_splats(scene.start.splats.take(own), degree)
        else:
            model = GaussianModel.from_points(scene.points, scene.colors, degree, own)
        self.model = model.to(self.device)
        self.background = torch.full((3,), float(config.data.white_background), device=self.device)
        seed, limit, growth = config.learn.seed, config.grow.max_gaussians, config.grow.growth
        setting = Setting(scene, self.model, self.background, processes, seed, limit, config.learn.iterations)
        self.parts = [PARTS[name].load()(config.plugins[name], setting) for name in config.used_parts]
        groups = [group for parameters in having(self.parts, "parameters") for group in parameters()]
        folder = self._folder() if config.machine.out_of_core else None
        self.optimizer = Optimizer(self.model, config.learn, scene.extent, processes.images, groups, folder)
        self.growth = GROWTHS[growth].load()(config.plugins[growth], setting, self.optimizer)
        self.told = [sentence for told in having([*self.parts, self.growth], "told") for sentence in told()]
        self.dropped: Counter = Counter()  # of NOT_FINITE, on the device; prunings that would have emptied the scene
        self.options = RasterOptions(antialiasing=config.model.antialiasing, projection=config.model.projection)
        self.degree = min(COEFFICIENTS.index(scene.start.splats.sh.shape[1]), degree) if scene.start else 0
        self.blocks = Blocks(self, processes) if isinstance(processes, Shards) else None
        self.deck = Deck(scene.train, seed)
        self.photographs = Photographs(config, scene, self.device, any(having(self.parts, "reads_alpha")))
        self.room = Room()  # for tile instances
        self._radii = self.model.parameters["means"].new_zeros(len(self.model), dtype=torch.int32)  # in the last step

    def _folder(self) -> Path:
        """Where the Gaussians live, in files. Raises InputError if an option does not go with that."""
        learn, images = self.config.learn, self.processes.images
        refused = {
            "--optimizer_type default, which changes all Gaussians in each step": learn.optimizer_type == "default",
            "--half_moments": learn.half_moments,  # are rounded by the number of a row
            "--device cuda": self.device.type == "cuda",
            f"{images} images a step": images > 1,
        }
        for name in filter(refused.get, refused):
            raise InputError(f"--out_of_core: expected sparse_adam, an image a step, a CPU, found {name}; change it.")
        return prepare_folder(self.config.report.model_path)

    def differentiate(self, iteration: int) -> torch.Tensor:
        """Gradients of the loss of a step's views; returns the loss, a scalar. Means over all views of all processes.

        Iterations count images from 1; with n views a step is n of them, and ``iteration`` the last one's.

        The reference evaluates and saves between this and :meth:`update`: a set that was densified a moment ago is
        unsettled and renders several dB worse.
        """
        self._set_iteration(iteration)
        self._radii = self._radii.new_empty(0)  # largest in any view; there was none yet
        steps = [Step(iteration, view, place) for place, view in enumerate(self.deck.deal(self.processes.images))]
        own = slice(self.processes.rank, None, self.processes.count)
        if len(self.photographs.kept) < len(self.scene.train) and not self.blocks:
            coming = enumerate([[step.view for step in steps], *self.deck.coming(len(steps), AHEAD)])
            self.photographs.expect((view, iteration + k * len(steps)) for k, views in coming for view in views[own])
        losses = self.blocks.differentiate(steps) if self.blocks else [self.differentiate_view(s) for s in steps[own]]
        loss = sum(losses[1:], losses[0])
        if self.config.learn.optimizer_type == "sparse_adam":
            self._radii = self._radii.clone()  # parts may have kept what they saw
            self.processes.merge(self._radii, largest=True)
        self.processes.average([*self.model.gradients(self.degree), *self.optimizer.part_gradients(), loss])
        return loss

    def differentiate_view(self, step: Step, splats: Splats2D | None = None) -> torch.Tensor:
        """Add the gradients of one view, down to its ``splats``, if they are given; returns its loss."""
        camera, photograph = self.photographs.at_size(step.view, step.iteration)
        options = self.options_at(step)
        camera, background = self._through("camera", camera, step), self._through("background", self.background, step)
        out, rows = self._render(camera, background, options, room=self.room, splats=splats)
        kept: list[torch.Tensor] = []
        out.means2d.register_hook(kept.append)  # retain_grad would copy it
        image = self._through("image", out.image, out, step)
        photograph = self._through("photograph", photograph, step)
        target = photograph.image
        if self.scene.linear:
            image, target = (LOSS_CURVES[self.config.data.loss_space](picture) for picture in (image, target))
        # clamped as in the reference's renderer: what is too bright learns nothing from being brighter still
        share = self.config.learn.lambda_dssim
        loss = image_loss(image, target, share, photograph.mask, clamped=not self.scene.linear)
        loss = self._through("loss", loss, out, step)
        for price in [] if splats else self.prices(out.gaussians):
            loss = loss + price.to(loss.dtype)
        loss.backward()  # given a gradient, torch would load sympy, for over a second
        if not splats:
            out.means2d.grad = kept[0] if kept else None
            self.see(out if rows is None else Observed.of_all(out, rows, len(self.model)), step)
        dropped = (out.dropped.pixel_count, out.dropped.gaussian_count, out.invalid_count)
        self.dropped.update(dict(zip(NOT_FINITE, dropped, strict=True)))
        return loss.detach()

    def options_at(self, step: Step) -> RasterOptions:
        """What the renderer is to compute in a step."""
        return replace(self._through("asks", self.options, step), sh_degree=self.degree)

    def prices(self, gaussians: Gaussians) -> list[torch.Tensor]:
        """What Gaussians cost by themselves, in each view."""
        return [price(gaussians) for price in having((*self.parts, self.growth), "price")]

    def see(self, out: RenderOutput | Observed, step: Step) -> None:
        """Note what a view showed of the Gaussians."""
        with stage("densify"):
            for observe in having([self.growth] if self.config.learn.grows_at(step.iteration) else [], "observe"):
                observe(out, step)
        self._radii = torch.maximum(self._radii, out.radii) if len(self._radii) else out.radii

    def _through(self, method: str, value: T, *arguments: Any) -> T:
        """What the parts and then the growth make of ``value``, one after another."""
        for make in having((*self.parts, self.growth), method):
            value = make(value, *arguments)
        return value

    def update(self, iteration: int) -> None:
        """Densify or take a step of Adam. A set that changed has no gradients yet, and no step, as in the reference."""
        with stage("densify"):
            changed = self.growth.update(iteration) if self.config.learn.grows_at(iteration) else None
        if changed is not None:
            self.check_identical(iteration)
            self.dropped["prunings"] += changed.refused
        with stage("Adam"):
            self.optimizer.step(self._radii if changed is None or changed.refused else None)
        for after_step in having((*self.parts, self.growth), "after_step"):
            after_step(iteration)

    def advance(self, iteration: int) -> torch.Tensor:
        """:meth:`update` after the step before, if there was one, then :meth:`differentiate`; returns the loss."""
        if (before := iteration - self.processes.images) > 0:
            self.update(before)
        return self.differentiate(iteration)

    def settle(self, begin: int, cooldown: int) -> None:
        """Let the cooldown begin at a step that is still to come: what was done is what these flags would have done."""
        self.config = self.config.changed(settle_from_iter=begin, cooldown=cooldown, minutes=0.0)
        self.optimizer.options = self.config.learn

    def warm_up(self) -> None:
        """Compile and load every kernel of a step, changing nothing."""
        view = self.scene.train[0]
        step = Step(0, view)
        camera = self._through("camera", view.camera.resized(2 * TILE, TILE), step)  # 2:1, as a panorama has to be
        out, _ = self._render(camera, self.behind, self.options_at(step))
        image_loss(out.image, torch.zeros_like(out.image), self.config.learn.lambda_dssim).backward()
        self.optimizer.zero_grad()
        self.optimizer.load()
        for load_kernels in having((self.growth, *self.parts), "load"):
            load_kernels()
        load(self.device, quarantine)  # launched only where a gradient is not finite

    def check_identical(self, iteration: int) -> None:
        """Raise GroupError if the model is not the same, byte for byte, in all processes."""
        own = [] if self.blocks else self.model.parameters.values()
        self.processes.check_identical([*own, *self.optimizer.parts.values()], iteration)

    def all_dropped(self) -> dict[str, int]:
        """What was dropped so far, by name, over all processes."""
        counts = torch.tensor([int(self.dropped[name]) for name in NOT_FINITE])
        self.processes.sum(counts)  # but a refused pruning is the same one everywhere
        return {**dict(zip(NOT_FINITE, counts.tolist(), strict=True)), "prunings": self.dropped["prunings"]}

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Tensors by name and values of JSON: all that :meth:`restore` needs to go on as if nothing had happened.

        All processes call it before the first step, or between :meth:`differentiate` and :meth:`update`, where models
        are saved. So a checkpoint holds the same parameters as the model of its iteration, and their gradients.
        """
        tensors = {**self.optimizer.state(), "radii": self._radii}
        for state in having((self.growth, *self.parts), "state"):
            tensors |= state()
        return tensors, {
            "views": [view.name for view in self.scene.train],
            "extent": self.scene.extent,
            "degree": self.degree,
            **self.deck.state(),
            **{f"dropped.{name}": count for name, count in self.all_dropped().items()},
        }

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint, by :meth:`update` of its iteration. Other options and devices may be at work.

        Raises:
            InputError: if its training views are not those of the scene, or something in it does not fit.
        """
        names, extent = [*map(str, checkpoint.fact("views", list))], checkpoint.fact("extent", float)
        here = [view.name for view in self.scene.train]
        if names != here or not math.isclose(extent, self.scene.extent, rel_tol=1e-6):
            more, fewer = {*here} - {*names}, {*names} - {*here}
            found = f"{self.scene.extent:.4g}" if names == here else "them in another order"
            found = f"{len(more)} more, {len(fewer)} fewer, such as {min(more | fewer):.60}" if more or fewer else found
            raise InputError(
                f"{checkpoint.path}: expected training views of the same names, order and extent ({extent:.4g}) as in "
                f"this checkpoint, found {found}; name the scene that it was trained on (-s, -i, --eval)."
            )
        self.deck.restore(checkpoint)
        counts = {name: checkpoint.count(f"dropped.{name}") for name in (*NOT_FINITE, "prunings")}
        if self.processes.rank > 0:  # the first process goes on with what is summed over all
            counts.update(dict.fromkeys(NOT_FINITE, 0))
        self.dropped = Counter(counts)
        self.optimizer.restore(checkpoint)
        for restore in having((self.growth, *self.parts), "restore"):
            restore(checkpoint)
        begun = checkpoint.count("degree") if "degree" in checkpoint.facts else 0  # unknown to older programs
        self.degree = min(begun, self.config.model.sh_degree)
        self._radii = torch.tensor(checkpoint.array("radii", (len(self.model),), np.int32), device=self.device)
        self._set_iteration(checkpoint.count("iteration"))

    def _set_iteration(self, iteration: int) -> None:
        self.optimizer.set_iteration(iteration)
        self.degree = max(self.degree, min(iteration // self.config.learn.sh_interval, self.config.model.sh_degree))

    def _shown(self, camera: Camera | CameraParameters, options: RasterOptions) -> torch.Tensor | None:
        """The Gaussians that a view needs, where they live in a file; None: all."""
        if not self.optimizer.folder:
            return None
        with torch.no_grad(), stage("project"):
            parts, options = torch.arange(len(self.model)).split(CHUNK), replace(options, sh_degree=0)
            radii = [project(self.model.activated(0, part), camera, options).radii for part in parts]
        return torch.cat(radii).nonzero()[:, 0]

    def _render(
        self, camera: Camera | CameraParameters, background: torch.Tensor, options: RasterOptions, **more: Any
    ) -> tuple[RenderOutput, torch.Tensor | None]:
        """A view, and the Gaussians of :meth:`_shown`; ``more``: what :func:`render` takes besides."""
        rows = self._shown(camera, options)
        with stage("project"):
            gaussians = self.model.activated(self.degree, rows)
        return render(gaussians, camera, background, options, self.config.model.adjoint, **more), rows

    @property
    def behind(self) -> torch.Tensor:
        """What pictures have behind the Gaussians: a color [3], or harmonics [16, 3]."""
        return self._through("behind", self.background)

    def look(self, camera: Camera, depth: bool = False, median: bool = False) -> RenderOutput:
        """The present model seen by ``camera``, without gradients; nothing of the training changes."""
        with torch.no_grad():
            options = replace(self.options, depth=depth, median_depth=median, sh_degree=self.degree)
            splats = self.blocks.ask("show", camera, options) if self.blocks else None
            return self._render(camera, self.behind, options, splats=splats)[0]

    def lead(self, do: Callable[[], T]) -> T | None:
        """What process 0 does while the others wait; what it looks at, it sees of the Gaussians of all.

        Where another process went away, each does it that holds the whole model: nobody knows which will be left.
        """
        if self.blocks:
            return self.blocks.lead(do)
        return do() if self.processes.rank == 0 or self.processes.lost else None

    def save(self, path: Path) -> None:
        """Write the model. Raises InputError if that fails."""
        (self.blocks or self.model).save(path, self.config.model.antialiasing)

    @property
    def exposures(self) -> Exposures | None:
        """How photographs were exposed, if a part learns it."""
        return next((found() for found in having(self.parts, "exposures")), None)

    def picture(self, camera: Camera, name: str = "") -> np.ndarray:
        """The present model seen by ``camera``, [H, W, 3] uint8, exposed as the photograph of this name."""
        return to_bytes(as_photographed(self.exposures, self.look(camera).image, name), self.scene.linear)

    def refined(self, views: list[View]) -> list[View]:
        """The views, with the cameras that parts have learned."""
        if not having(self.parts, "refined"):
            return views
        through = lambda camera, view: self._through("refined", camera, view)  # noqa: E731
        return [replace(v, camera=through(v.camera, v), original=through(v.original, v)) for v in views]

    def where_taken(self) -> Callable[[View], Camera] | None:
        """A function from a held-out view to where the model says that it was taken, if parts refine cameras."""
        if not having(self.parts, "refined") or not self.scene.test:
            return None
        seen = self.model.activated(self.degree), self.behind, self.options, self.scene.extent
        return where_taken(*seen, partial(as_photographed, self.exposures), self.scene.linear)

    def evaluate(self, views: list[View]) -> float:
        """Mean PSNR [dB] of 8-bit renders against the photographs, as a screen shows both."""
        shown = lambda view: psnr(self.picture(view.camera, view.name), view.picture, view.mask)  # noqa: E731
        return float(np.mean([shown(view) for view in in_turn(self.refined(views))]))
