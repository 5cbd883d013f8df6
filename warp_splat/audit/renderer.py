"""A renderer in a process of its own, which may hang or die: what it drew, and how its gradients came out."""

import importlib
import multiprocessing
import os
import signal
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from warp_splat.audit.program import draw_by_page, draw_by_program
from warp_splat.compare.truth import PARAMETERS
from warp_splat.compare.workloads import Workload
from warp_splat.errors import InputError, reason_of

START_LIMIT = 300.0  # s for its imports, of which some compile
REFUSES = "refuses"


class RendererFailed(Exception):
    """Why there is no picture: a phrase."""


@dataclass(frozen=True)
class Answer:
    """What came back."""

    image: np.ndarray  # [H, W, 3] float64
    eight_bit: bool
    gradients: dict[str, torch.Tensor]  # by parameter; empty: it has none
    same: bool  # every run gave the same bits
    runs: int = 1


class Renderer:
    """Draws with ``MODULE:function``, a page or a program's command line; started again after each failure.

    The function takes means [N, 3], quats [N, 4] (w first), scales [N, 3], opacities [N], sh [N, K, 3] (float32,
    activated), a :class:`warp_splat.Camera` and the background [3]. It returns the picture [H, W, 3], float or uint8.
    """

    def __init__(self, place: str, limit: float = 60.0):
        self.place, self.limit = place, limit
        self.process: Any = None
        self.folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)  # for what is killed before it tidies up

    def start(self) -> None:
        """Start its process, unless it runs. Raises RendererFailed if what draws cannot be imported there."""
        if self.process is None:
            context = multiprocessing.get_context("spawn")
            self.connection, other = context.Pipe()
            self.process = context.Process(target=_serve, args=(other, self.place, self.folder.name), daemon=True)
            self.process.start()
            other.close()
            self._receive(START_LIMIT, serves=False)

    def draw(self, workload: Workload, upstream: torch.Tensor | None = None, runs: int = 1) -> Answer:
        """The picture, and the gradients for ``upstream`` [H, W, 3].

        Raises:
            RendererFailed: if it hangs, dies, refuses, or returns something else.
        """
        self.start()
        given = [tensor.numpy() for tensor in (*workload.gaussians, workload.background)]
        with suppress(OSError):  # it has died since the last answer
            self.connection.send((given, workload.camera, None if upstream is None else upstream.numpy(), runs))
        image, gradients, same = self._receive(self.limit * runs)
        if image.shape != (shape := (workload.camera.height, workload.camera.width, 3)):
            raise RendererFailed(f"returned shape {image.shape}, not {shape}")
        if image.dtype != np.uint8 and image.dtype.kind != "f":
            raise RendererFailed(f"returned {image.dtype}, neither floats nor uint8")
        found = {name: torch.from_numpy(array) for name, array in gradients.items()}
        eight_bit = image.dtype == np.uint8
        return Answer(image.astype(np.float64) / (255 if eight_bit else 1), eight_bit, found, same, runs)

    def _receive(self, limit: float, serves: bool = True):
        """What the process answers; ``serves``: whether it goes on after it has refused."""
        try:
            found = self.connection.recv() if self.connection.poll(limit) else f"hangs: no answer in {limit:g} s"
        except (EOFError, OSError):
            self.process.join()
            found = f"crashes: its process ended with {self.process.exitcode}"
        if isinstance(found, str):
            if not (serves and found.startswith(REFUSES)):
                self.close()
            raise RendererFailed(found)
        return found

    def close(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            with suppress(OSError, AttributeError):  # what it has started, which may tidy up; Windows has no groups
                os.killpg(self.process.pid, signal.SIGTERM)
            self.process = None


def function_of(place: str):
    """What draws: the function of ``MODULE:function``, ``PAGE.html``, or a program's command line, which has braces.

    Raises:
        InputError: if there is none.
    """
    if "{" in place:
        return draw_by_program(place)
    if place.endswith(".html"):
        return draw_by_page(place)
    module, _, name = place.partition(":")
    try:
        function = getattr(importlib.import_module(module), name)
    except BaseException as error:  # whatever a module of others does when it is imported
        raise InputError(f"{place}: expected MODULE:function that can be imported, found {error!r}.") from error
    if not callable(function):
        raise InputError(f"{place}: expected a function, found {type(function).__name__}.")
    return function


def _serve(connection, place: str, folder: str) -> None:
    """The loop of the process: Gaussians in, picture and gradients out, or a phrase that says what went wrong.

    ``folder``: for temporary files.
    """
    os.environ["TMPDIR"] = tempfile.tempdir = folder
    with suppress(AttributeError):
        os.setsid()  # Ctrl-C is for the one that asks
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what it prints is not the audit's to say
    try:
        render = function_of(place)
        connection.send(())
    except Exception as error:
        connection.send(_phrase(error))
        return
    with suppress(EOFError):  # the other end is gone
        while True:
            given, camera, upstream, runs = connection.recv()
            try:
                runs = [_draw(render, given, camera, upstream) for _ in range(runs)]
                connection.send((*runs[0], all(_bits(run) == _bits(runs[0]) for run in runs)))
            except Exception as error:
                connection.send(_phrase(error))


def _phrase(error: Exception) -> str:
    return f"{REFUSES}: {type(error).__name__}: {reason_of(error)}"


def _bits(run) -> bytes:
    image, gradients = run
    return b"".join(array.tobytes() for array in (image, *gradients.values()))


def _draw(render, given: list[np.ndarray], camera, upstream: np.ndarray | None):
    *geometry, sh_dc, sh_rest, background = (torch.from_numpy(array.copy()) for array in given)
    sh = torch.cat([sh_dc, sh_rest], 1)
    leaves = [tensor.requires_grad_(upstream is not None) for tensor in (*geometry, sh, background)]
    image = render(*leaves[:5], camera, background)
    if upstream is None or not isinstance(image, torch.Tensor) or not image.requires_grad:
        return np.asarray(image.detach().cpu() if isinstance(image, torch.Tensor) else image), {}
    found = torch.autograd.grad(image, leaves, torch.from_numpy(upstream).to(image), allow_unused=True)
    named = zip(PARAMETERS, found, strict=False)
    return image.detach().cpu().numpy(), {name: value.cpu().numpy() for name, value in named if value is not None}
