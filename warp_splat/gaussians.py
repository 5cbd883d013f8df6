"""The trained set: raw parameters as torch leaves, their activations, and how they start."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from warp_splat.formats.curve import along_curve, keys_of
from warp_splat.formats.ply import save_ply_parts
from warp_splat.formats.splats import SplatArrays
from warp_splat.kernels.activation import make_activate, make_adj_activate
from warp_splat.kernels.falloff import LN_2
from warp_splat.kernels.harmonics import C0
from warp_splat.raster.data import Gaussians
from warp_splat.raster.drivers import driver_of
from warp_splat.runtime.distributed import ALONE, Processes
from warp_splat.runtime.launch import launch_in_lanes
from warp_splat.runtime.timers import adjoint_of

INITIAL_OPACITY = 0.1
CHUNK = 2**16  # Gaussians that are taken at once, where all together would take much memory
SMALLEST_DISTANCE2 = 1e-7  # world units^2, floor of the mean squared distance to the nearest points


def activate(logarithms: torch.Tensor, logits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Scales [N, 3] from their logarithms, opacities [N] from logits. What is too large ends at 1.7e38."""
    return _launched(make_activate, logarithms, logits)


def _launched(make, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Two tensors of the shapes of the last two inputs."""
    scales, opacities = (tensor.new_empty(tensor.shape) for tensor in inputs[-2:])
    launch_in_lanes(make, driver_of(scales.device).lanes, inputs, [scales, opacities])
    return scales, opacities


class Activate(torch.autograd.Function):
    """:func:`activate` for autograd."""

    @staticmethod
    def forward(ctx, logarithms, logits):
        found = activate(logarithms, logits)
        ctx.save_for_backward(*found)
        return found

    @staticmethod
    @adjoint_of("project")  # with whose stage it counts forward, too
    def backward(ctx, *adj_outputs):
        return _launched(make_adj_activate, *ctx.saved_tensors, *(adj.contiguous() for adj in adj_outputs))


class Taken(torch.autograd.Function):
    """Some rows of a leaf, whose gradient holds those rows alone."""

    @staticmethod
    def forward(ctx, leaf, rows):
        ctx.rows, ctx.shape = rows, leaf.shape
        return leaf[rows]

    @staticmethod
    @adjoint_of("project")
    def backward(ctx, adj_rows):
        known = {"is_coalesced": True, "check_invariants": False}  # indices ascend
        return torch.sparse_coo_tensor(ctx.rows[None], adj_rows, ctx.shape, **known), None


class GaussianModel:
    """N Gaussians before activation.

    Attributes:
        parameters: name -> leaf tensor with N rows: means [N, 3], sh_dc [N, 1, 3], sh_rest [N, K-1, 3], opacities
            [N] (logits), scales [N, 3] (logarithms), quats [N, 4] (any norm).
    """

    NAMES = ("means", "sh_dc", "sh_rest", "opacities", "scales", "quats")

    def __init__(self, parameters: dict[str, torch.Tensor]):
        dense = torch.contiguous_format  # of no Gaussians, too, for which arrays have strides of their own
        self.parameters = {
            name: parameters[name].detach().clone(memory_format=dense).requires_grad_() for name in self.NAMES
        }

    def __len__(self) -> int:
        return len(self.parameters["means"])

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.parameters["means"].device

    def to(self, device: torch.device) -> GaussianModel:
        """A copy on ``device``."""
        return GaussianModel({name: tensor.to(device) for name, tensor in self.parameters.items()})

    def arranged(self, processes: Processes = ALONE) -> GaussianModel:
        """A copy whose Gaussians come in the order along the curve; with ``processes``, equal shares of all of them."""
        moved = self.arranging(processes, [len(self)])
        return GaussianModel({name: moved(tensor.detach()) for name, tensor in self.parameters.items()})

    def arranging(self, processes: Processes, sizes: Sequence[int]) -> Callable[[torch.Tensor], torch.Tensor]:
        """A function that puts rows in that order; ``sizes``: of the pieces in which they come."""
        return processes.sorting(keys_of(self.parameters["means"], processes), sizes)

    @classmethod
    def from_points(
        cls, points: np.ndarray, colors: np.ndarray, sh_degree: int, own: np.ndarray | slice = slice(None)
    ) -> GaussianModel:
        """Start from the ``own`` of the points [P, 3] with colors [P, 3] uint8, as the reference does.

        A point becomes a ball as wide as the root mean squared distance to its three nearest neighbors, opacity 0.1.
        """
        from scipy.spatial import KDTree  # noqa: PLC0415 - slow to load, and only trainings start from points

        neighbors = min(4, len(points))  # the point itself and three others
        tree, centers, colors = KDTree(points), points[own], colors[own]
        count = len(centers)
        nearest = tree.query(centers, k=neighbors)[1].reshape(count, neighbors)[:, 1:]
        offsets = points[nearest].astype(np.float64) - centers[:, None]
        # fewer than four points: no or few neighbors; one unit then
        squared = np.mean((offsets * offsets).sum(2), axis=1) if neighbors > 1 else np.ones(count)
        scales = 0.5 * logarithm(np.maximum(squared, SMALLEST_DISTANCE2))
        tensor = lambda array: torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))  # noqa: E731
        parameters = {
            "means": tensor(centers),
            "sh_dc": tensor((colors / 255.0 - 0.5) / C0)[:, None],
            "sh_rest": torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
            "opacities": torch.full((count,), float(np.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY)))),
            "scales": tensor(scales)[:, None].repeat(1, 3),
            "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        }
        return cls(parameters)

    def gradients(self, degree: int) -> list[torch.Tensor]:
        """The gradients, without those of the SH coefficients above ``degree``, which are zero. Views, not copies.

        Sparse ones are left out: a step that has them is of one image, with nothing to average.
        """
        found = {name: leaf.grad for name, leaf in self.parameters.items() if leaf.grad is not None}
        found = {name: grad for name, grad in found.items() if not grad.is_sparse}
        if "sh_rest" in found:
            found["sh_rest"] = found["sh_rest"][:, : (degree + 1) ** 2 - 1]
        return list(found.values())

    def activated(self, degree: int | None = None, rows: torch.Tensor | None = None) -> Gaussians:
        """As the renderer takes them; with ``rows`` (indices) only those, and gradients are sparse.

        At ``degree`` 0, sh_rest is empty, so that none of the 45 numbers gets a gradient, or is read.
        """
        raw = dict(self.parameters)
        if degree == 0:
            raw["sh_rest"] = raw["sh_rest"].detach()[:, :0]
        if rows is not None:
            raw = {name: Taken.apply(leaf, rows) for name, leaf in raw.items()}
        raw["scales"], raw["opacities"] = Activate.apply(raw["scales"], raw["opacities"])
        return Gaussians(**raw)

    def splats(self, rows: torch.Tensor | slice = slice(None)) -> SplatArrays:
        """The Gaussians, or some ``rows``, as files have them."""
        raw = {name: tensor.detach()[rows].cpu() for name, tensor in self.parameters.items()}  # the device may be full
        raw["sh"] = torch.cat([raw.pop("sh_dc"), raw.pop("sh_rest")], 1)
        return SplatArrays(**{name: tensor.numpy() for name, tensor in raw.items()})

    def save(self, path: Path, antialiased: bool = False) -> None:
        """Write a PLY file in the reference's layout, arranged; a part after another, since memory may be short."""
        parts = along_curve(self.parameters["means"].cpu()).split(CHUNK)
        save_ply_parts(path, len(self), map(self.splats, parts), antialiased)

    @classmethod
    def from_splats(cls, splats: SplatArrays, sh_degree: int | None = None) -> GaussianModel:
        """Start from Gaussians of a file; with ``sh_degree``, coefficients beyond it are left out, missing ones 0."""
        if sh_degree is not None:
            coefficients = (sh_degree + 1) ** 2
            sh = splats.sh[:, :coefficients]
            splats = splats._replace(sh=np.pad(sh, ((0, 0), (0, coefficients - sh.shape[1]), (0, 0))))
        means, sh, opacities, scales, quats = (torch.from_numpy(np.ascontiguousarray(array)) for array in splats)
        parameters = {"means": means, "sh_dc": sh[:, :1], "sh_rest": sh[:, 1:]}
        return cls({**parameters, "opacities": opacities, "scales": scales, "quats": quats})


def logarithm(x: np.ndarray) -> np.ndarray:
    """The natural logarithm to 1e-9; NumPy's differs by processor. As 2 artanh((m - 1) / (m + 1)) of a mantissa m."""
    m, exponent = np.frexp(x)
    s = (m - 1.0) / (m + 1.0)
    return exponent * LN_2 + 2.0 * s * np.polyval(1.0 / np.arange(19, 0, -2), s * s)
