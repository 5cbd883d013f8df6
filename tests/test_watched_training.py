"""A training that is watched: the same bytes, its pauses, its end; the place of browsers is taken by a fake."""

import signal
import sys

import pytest
from commands import CtrlC
from fake_viser import PHOTO, FakeClient, FakeServer, at_rest, some_scene
from scene_files import write_colmap
from trainings import begin, steps

from warp_splat.cli import main
from warp_splat.training.live import TrainingViewer
from warp_splat.training.options import TrainConfig
from warp_splat.training.record import Run, finish
from warp_splat.training.trainer import Trainer
from warp_splat.viewer import server


def watch_training(trainer, run):
    viewer = server.Viewer(trainer.look, trainer.model, trainer.scene, 8080)
    return viewer, TrainingViewer(trainer, run, viewer)


def watched(watch, count=12):
    """Parameters after a few steps, with ``watch`` called after each as the loop does."""
    trainer, run = begin(some_scene(), None, iterations=count, sh_interval=4, densify_from_iter=2, quiet=True)
    look = watch(trainer, run)
    steps(trainer, run, count, lambda: look([]))
    return {name: tensor.detach().numpy().tobytes() for name, tensor in trainer.model.parameters.items()}


def test_training_is_the_same_with_somebody_looking(fake_viser, monkeypatch):
    clients = []
    at_rest(monkeypatch)
    monkeypatch.setattr("warp_splat.training.live.REFRESH", 0.0)
    monkeypatch.setattr("warp_splat.training.live.SHARE", 1e9)

    def watch(trainer, run):
        viewer, training = watch_training(trainer, run)
        for number, kind in enumerate(("image", "depth", "alpha")):
            clients.append(FakeClient(number, trainer.scene.train[0].camera))
            viewer.server.enter(clients[-1])
            viewer.watchers[number].kind.value = kind
        return training.between_steps

    assert watched(watch) == watched(lambda trainer, run: lambda interrupted: None)
    assert sum(len(client.frames) for client in clients) >= 12


def test_nobody_looking_costs_nothing(fake_viser):
    def watch(trainer, run):
        viewer, training = watch_training(trainer, run)
        viewer.draw = viewer.refresh = None  # not to be called
        return training.between_steps

    watched(watch, 2)


class Paused:
    """A training that is paused, and what happens while it waits."""

    def __init__(self, monkeypatch, happens):
        trainer = Trainer(some_scene(), TrainConfig(iterations=10))
        self.viewer, self.training = watch_training(trainer, Run(None, 0.0))
        self.client = FakeClient(1, trainer.scene.train[0].camera)
        self.viewer.server.enter(self.client)
        self.interrupted, self.waits = [], 0
        self.training._toggle()

        def wait():
            self.waits += 1
            if self.waits == 3:
                happens(self)

        monkeypatch.setattr(self.viewer, "wait", wait)
        at_rest(monkeypatch)
        self.training.between_steps(self.interrupted)


@pytest.mark.parametrize(
    "happens",
    [
        lambda paused: paused.training._toggle(),
        lambda paused: paused.interrupted.append(2),
        lambda paused: paused.viewer.server.leave(paused.client),
    ],
    ids=["continue", "Ctrl-C", "the browser is closed"],
)
def test_pause_ends(fake_viser, monkeypatch, happens):
    monkeypatch.setattr(server, "DESERTED", 0.0)
    paused = Paused(monkeypatch, happens)
    assert paused.waits >= 3 and (not paused.training.paused or paused.interrupted)


def test_a_pause_while_a_frame_is_drawn_is_told(fake_viser, monkeypatch):
    trainer, interrupted = Trainer(some_scene(), TrainConfig(iterations=10)), []
    viewer, training = watch_training(trainer, Run(None, 0.0))
    viewer.server.enter(FakeClient(1, trainer.scene.train[0].camera))
    draw = viewer.draw

    def draw_and_click():
        if not training.paused:
            training._toggle()
        return draw()

    monkeypatch.setattr(viewer, "draw", draw_and_click)
    monkeypatch.setattr(viewer, "wait", lambda: interrupted.append(2))
    training.between_steps(interrupted)
    assert training.paused and "paused" in training._facts.content


def test_the_end_is_shown_once_to_everybody(fake_viser):
    """Also while one drags on and on, and where Pause was clicked during the last step."""
    trainer, run = Trainer(some_scene(), TrainConfig(iterations=10)), Run(None, 0.0, iteration=10)
    viewer, training = watch_training(trainer, run)
    clients = [FakeClient(number, trainer.scene.train[0].camera) for number in (1, 2)]
    for client in clients:
        viewer.server.enter(client)
    receive = clients[0].scene.set_background_image

    def dragged(frame, **options):
        receive(frame, **options)
        clients[0].moved()

    clients[0].scene.set_background_image = dragged
    training._toggle()
    training.show_end()
    assert [len(client.frames) for client in clients] == [1, 1]
    assert training._button.disabled and "paused" not in training._facts.content


class Visited(FakeServer):
    """With a browser from the start, which leaves at the second wait."""

    def on_client_disconnect(self, handler):
        super().on_client_disconnect(handler)
        self.client, self.waits, self.seen = FakeClient(1, PHOTO), 0, []
        self.enter(self.client)
        Visited.last = self

    def wait(self):
        self.waits += 1
        if self.waits == 2:
            self.leave(self.client)


def visited(monkeypatch, folder):
    """The command that trains a small scene while somebody looks, who leaves at the second wait."""
    root = write_colmap(folder / "scene", points=())
    monkeypatch.setattr(sys.modules["viser"], "ViserServer", Visited)
    monkeypatch.setattr(server, "DESERTED", 0.0)
    monkeypatch.setattr("warp_splat.training.live.REFRESH", 0.0)
    monkeypatch.setattr("warp_splat.training.live.SHARE", 1e9)
    monkeypatch.setattr(server.Viewer, "wait", lambda viewer: viewer.server.wait())
    at_rest(monkeypatch)
    return ["train", "-s", str(root), "-m", str(folder / "model"), "--viewer", "--iterations", "3"]


def test_a_training_is_watched_to_its_end(fake_viser, monkeypatch, tmp_path, capsys):
    """From the command line: frames while it trains, the end before it is evaluated, and then it lingers."""
    command = visited(monkeypatch, tmp_path)

    def evaluated(*_):
        seen = Visited.last
        seen.seen = [len(seen.client.frames), seen.gui.add_button().disabled]
        return finish(*_)

    monkeypatch.setattr("warp_splat.training.command.finish", evaluated)
    assert main(command) == 0
    seen, said = Visited.last, capsys.readouterr()
    assert seen.seen == [3, True] and seen.waits == 2 and seen.stopped  # after two steps and at the end
    assert "Viewer at http" in said.out and "The viewer stays at" in said.out
    assert "no points to start from" in said.out and "Done after 3 iterations" in said.out


@pytest.mark.parametrize(("line", "code"), [("Viewer at", 130), ("The viewer stays at", 0)])
def test_who_reads_the_line_may_press_ctrl_c(line, code, fake_viser, monkeypatch, tmp_path, capsys):
    """While it is printed, Ctrl-C is heeded already, even if the shell has the process ignore it."""
    output = CtrlC(line)
    monkeypatch.setattr(sys, "stdout", output)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert main(visited(monkeypatch, tmp_path)) == code
    finally:
        signal.signal(signal.SIGINT, before)
    assert output.heeded == [True] and Visited.last.waits < 2
