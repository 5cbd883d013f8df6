"""A training in the browser: its progress, pause and continue, and frames between two steps."""

import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

from tqdm import tqdm

from warp_splat.runtime import timers
from warp_splat.runtime.interrupts import interruptible
from warp_splat.training.record import Run
from warp_splat.training.trainer import Trainer
from warp_splat.viewer.server import Viewer

REFRESH = 1.0  # seconds between two frames of what nobody moves, at least
SHARE = 0.1  # of the time goes into those frames, at most


class TrainingViewer:
    """What a browser sees of a training, drawn in the thread that trains, between two steps.

    While somebody moves, training waits, so that frames come quickly. While the page is still, a frame is drawn each
    second. While nobody is there, none is. The model does not depend on any of that.
    """

    def __init__(self, trainer: Trainer, run: Run, viewer: Viewer):
        self.trainer, self.run, self.viewer = trainer, run, viewer
        self.paused = False
        self._refresh_at, self._drawing = 0.0, 0.0  # on time.monotonic; seconds of drawing at rest since then
        with viewer.gui.add_folder("Training"):
            self._bar = viewer.gui.add_progress_bar(0.0)
            self._facts = viewer.gui.add_markdown("")
            self._button = viewer.gui.add_button("Pause")
        self._button.on_click(self._toggle)

    def _toggle(self, _=None) -> None:
        self.paused = not self.paused
        self._button.label = "Continue" if self.paused else "Pause"
        self.viewer.wake()

    @timers.profile(False)
    def between_steps(self, interrupted: list[int]) -> None:
        """Draw what is due; return when training may go on, or must end."""
        if not self.viewer.watchers and not self.paused:
            return
        now, told = time.monotonic(), False
        if now >= self._refresh_at + max(REFRESH, self._drawing / SHARE):
            self._refresh_at, self._drawing = now, 0.0
            self._tell()
            self.viewer.refresh()
        while not interrupted:
            if self.paused and not told:  # by a click that came while a frame was drawn, too
                told = True
                self._tell()
                tqdm.write(f"Paused after {self.run.iteration} iterations in the viewer, {self.viewer.address}")
            drawn = self._draw()
            if self.paused and self.viewer.deserted:
                self._toggle()
                tqdm.write("Training goes on: nobody looks any more.")
            if not self.paused and not self.viewer.moving:
                return
            if not drawn:
                self.viewer.wait()

    @timers.profile(False)
    def show_end(self) -> None:
        """Show the model as it was saved, once to everybody; evaluating it takes a while."""
        self._button.disabled = True
        self.paused = False  # by a click during the last step
        self._tell()
        self.viewer.refresh()
        for _ in list(self.viewer.watchers):
            self.viewer.draw()

    @timers.profile(False)
    def linger(self) -> None:
        """After the training, stay until the last browser has left, or Ctrl-C."""
        if self.viewer.deserted:
            return
        with interruptible() as interrupted:
            print(f"The viewer stays at {self.viewer.address} until its page is closed, or Ctrl-C.", flush=True)
            while not interrupted and not self.viewer.deserted:
                if not self._draw():
                    self.viewer.wait()

    def _draw(self) -> bool:
        resting, start = not self.viewer.moving, time.monotonic()
        drawn = self.viewer.draw()
        if resting:
            self._drawing += time.monotonic() - start
        return drawn

    def _tell(self) -> None:
        run, end = self.run, self.trainer.config.learn.end_or_plan
        self._bar.value = 100.0 * run.iteration / end
        lines = [f"iteration {run.iteration:,} of {end:,}" + ", paused" * self.paused]
        if run.seconds:
            lines.append(f"{run.iteration / run.seconds:.1f} per second")
        if run.history:
            last = run.history[-1]
            lines.append(f"loss {last['loss']:.4f}, PSNR {last['psnr']:.2f} dB")
        self._facts.content = "  \n".join(lines)


@contextmanager
def watched(trainer: Trainer, run: Run) -> Iterator[TrainingViewer | None]:
    """Serve a viewer of the training while the block runs, in process 0; None in others.

    Raises:
        InputError: if no port is free.
    """
    scene, port, exposures = trainer.scene, trainer.config.report.port, lambda: trainer.exposures
    viewer = trainer.lead(lambda: Viewer(trainer.look, trainer.model, scene, port, scene.linear, exposures))
    with viewer or nullcontext():
        yield TrainingViewer(trainer, run, viewer) if viewer else None
