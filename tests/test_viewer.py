"""The handlers of the viewer and a training that is watched, with the place of browsers taken by a fake."""

import signal
import socket
import sys
from contextlib import contextmanager, nullcontext
from importlib.metadata import version

import numpy as np
import pytest
import torch
from commands import CtrlC
from fake_viser import PHOTO, FakeClient, FakeServer, at_rest, drawn, some_gaussians, some_scene, wxyz
from scene_files import write_colmap
from trainings import begin, steps

from warp_splat.cli import main
from warp_splat.color import to_srgb
from warp_splat.config import RasterOptions, ViewConfig
from warp_splat.errors import InputError
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.splats import SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.finished import make_renderer
from warp_splat.training.live import TrainingViewer
from warp_splat.training.options import TrainConfig
from warp_splat.training.record import Run, finish
from warp_splat.training.trainer import Trainer
from warp_splat.viewer import server
from warp_splat.viewer.command import view_model
from warp_splat.viewer.watcher import MOST


@pytest.fixture
def viewer(fake_viser):
    model, scene = GaussianModel.from_splats(some_gaussians(50)), some_scene()
    draw = make_renderer(model, False, RasterOptions())
    with server.Viewer(draw, lambda: model.parameters["means"], scene, 8080) as viewer:
        yield viewer
    assert viewer.server.stopped


@pytest.fixture(scope="module")
def served():
    """The port of a server of viser's."""
    made = server._serve(server.free_port(8080))
    yield made.get_port()
    made.stop()


@pytest.mark.parametrize(
    ("host", "origin", "open"),
    [
        ("127.0.0.1:{}", "http://127.0.0.1:{}", True),
        ("localhost:9000", "http://localhost:9000", True),  # through ssh -L
        ("192.168.0.7:{}", "https://192.168.0.7:{}", True),
        (socket.gethostname() + ":{}", f"http://{socket.gethostname()}:{{}}", True),
        ("127.0.0.1:{}", "http://evil.example", False),
        ("127.0.0.1:{}", "http://127.0.0.1:1", False),  # another server on this machine
        ("127.0.0.1:{}", "null", False),
        ("127.0.0.1:{}", None, False),
        ("evil.example:{}", "http://evil.example:{}", False),  # a name that was made to point here
        ("[:{}", "http://[:{}", False),
    ],
)
def test_only_its_own_page_may_connect(served, host, origin, open):
    request = f"GET / HTTP/1.1\r\nHost: {host}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    request += "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    request += f"Sec-WebSocket-Protocol: viser-v{version('viser')}\r\n"
    request += f"Origin: {origin}\r\n\r\n" if origin else "\r\n"
    with socket.create_connection(("127.0.0.1", served)) as connection:
        connection.sendall(request.replace("{}", str(served)).encode())
        assert connection.recv(4096).startswith(b"HTTP/1.1 101" if open else b"HTTP/1.1 403")


@pytest.mark.parametrize(("host", "status"), [("127.0.0.1", b"200"), ("evil.example", b"403")])
def test_no_other_name_gets_the_page(served, host, status):
    with socket.create_connection(("127.0.0.1", served)) as connection:
        connection.sendall(f"GET / HTTP/1.1\r\nHost: {host}:{served}\r\n\r\n".encode())
        assert connection.recv(4096).startswith(b"HTTP/1.1 " + status)


def test_frames_are_quick_while_moving_and_sharp_at_rest(viewer, monkeypatch):
    client = FakeClient(1, PHOTO, size=(960, 640))
    viewer.server.enter(client)
    viewer.watchers[1].pace.pixels = 96 * 64
    assert viewer.moving and drawn(viewer) == 1 and drawn(viewer) == 0
    frame, quality = client.frames[-1]
    assert frame.shape == (64, 96, 3) and quality == server.MOVING_QUALITY
    client.moved()
    assert drawn(viewer) == 1 and len(client.frames) == 2
    at_rest(monkeypatch)
    assert drawn(viewer) == 1 and drawn(viewer) == 0 and not viewer.moving
    frame, quality = client.frames[-1]
    assert frame.shape == (640, 960, 3) and quality == server.SHARP_QUALITY
    assert "960 x 640 px" in viewer.watchers[1].note.content


def test_a_training_camera_and_its_photograph(viewer, monkeypatch):
    at_rest(monkeypatch)
    client = FakeClient(1, PHOTO, size=(120, 60))
    viewer.server.enter(client)
    looks = viewer.watchers[1]
    looks.opacity.value = 1.0
    drawn(viewer)
    looks.steps.call(value="next")
    assert looks.view.value == "0.png"
    view = viewer.views["0.png"]
    np.testing.assert_allclose(client.camera.position, view.camera.center)
    np.testing.assert_allclose(np.abs(client.camera.wxyz @ wxyz(view.camera)), 1)
    drawn(viewer)
    frame = client.frames[-1][0]
    np.testing.assert_array_equal(frame[:, 30:90], view.image)  # the size of the photograph, in the middle
    assert not np.array_equal(frame[:, :30], view.image[:, :30])
    looks.opacity.value = 0.0
    drawn(viewer)
    np.testing.assert_array_equal(client.frames[-1][0][:, 30:90], picture_of(viewer, view.camera))
    for step, name in (("again", "0.png"), ("previous", "2.png"), ("next", "0.png"), ("next", "1.png")):
        looks.steps.call(value=step)
        assert looks.view.value == name
    looks.opacity.value = 1.0
    client.camera.position = client.camera.position + 0.5
    client.moved()
    drawn(viewer)
    assert not np.array_equal(client.frames[-1][0][:, 30:90], view.image)  # no longer there: no photograph


def picture_of(viewer, camera):
    image = viewer.draw_camera(camera, False).image
    return (image.clamp(0, 1) * 255).round().byte().numpy()


def test_kinds_of_frames(viewer, monkeypatch):
    at_rest(monkeypatch)
    client = FakeClient(1, some_scene().train[0].camera)
    viewer.server.enter(client)
    frames = {}
    for kind in ("image", "depth", "alpha"):
        viewer.watchers[1].kind.value = kind
        assert drawn(viewer) == 1
        frames[kind] = client.frames[-1][0]
    assert (frames["alpha"] == frames["alpha"][..., :1]).all() and frames["alpha"].max() > 200
    assert not np.array_equal(frames["depth"], frames["image"]) and frames["depth"].any()
    assert "depth" not in viewer.watchers[1].note.content


def test_two_browsers_and_one_that_leaves(viewer, monkeypatch):
    at_rest(monkeypatch)
    one, other = FakeClient(1, PHOTO), FakeClient(2, some_scene().train[0].camera)
    assert viewer.deserted
    viewer.server.enter(one)
    viewer.server.enter(other)
    assert drawn(viewer) == 2 and not np.array_equal(one.frames[0][0], other.frames[0][0])
    viewer.watchers[1].kind.value = "alpha"
    assert drawn(viewer) == 1 and len(other.frames) == 1
    viewer.refresh()
    assert drawn(viewer) == 2
    viewer.server.leave(one)
    viewer.refresh()
    assert drawn(viewer) == 1 and len(one.frames) == 3 and not viewer.deserted
    viewer.server.leave(other)
    assert drawn(viewer) == 0 and not viewer.deserted  # it may be loading the page again
    monkeypatch.setattr(server, "DESERTED", 0.0)
    assert viewer.deserted


def test_one_that_leaves_while_its_frame_is_drawn(viewer):
    client = FakeClient(1, PHOTO)
    viewer.server.enter(client)
    draw = viewer.draw_camera

    def leave(camera, depth):
        viewer.server.leave(client)
        return draw(camera, depth)

    viewer.draw_camera = leave
    assert drawn(viewer) == 1 and client.frames == []


@pytest.mark.parametrize("size", [(0, 0), (100_000, 100_000)])
def test_windows_of_strange_sizes(viewer, monkeypatch, size):
    at_rest(monkeypatch)
    client = FakeClient(1, PHOTO, size=size)
    viewer.server.enter(client)
    assert drawn(viewer) == 1
    assert [frame.shape[0] * frame.shape[1] <= MOST for frame, _ in client.frames] == [True] * (size != (0, 0))


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("coefficients", [1, 16])
def test_small_models(fake_viser, count, coefficients):
    """Also an empty one, and one without spherical harmonics."""
    model = GaussianModel.from_splats(some_gaussians(count, coefficients))
    draw = make_renderer(model, False, RasterOptions())
    with server.Viewer(draw, lambda: model.parameters["means"], None, 8080) as viewer:
        client = FakeClient(1, PHOTO)
        viewer.server.enter(client)
        for kind in ("image", "depth", "alpha"):
            viewer.watchers[1].kind.value = kind
            assert drawn(viewer) == 1
        assert len(client.frames) == 3


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (ViewConfig(), "MODEL: expected the folder"),
        (ViewConfig("no/such/folder"), "found no such folder"),
        (ViewConfig("no/such.ply"), "no/such.ply"),
        (ViewConfig("no/such.ply", port=0), "--port: expected"),
    ],
)
def test_what_cannot_be_viewed(config, message):
    with pytest.raises(InputError, match=message):
        view_model(config)


@pytest.mark.parametrize("source", ["", "scene"])
def test_a_file_of_a_scene_in_linear_light(fake_viser, monkeypatch, tmp_path, source):
    """A file does not say what light it was trained in; its scene does."""
    root = write_colmap(tmp_path / "scene", ["a.exr", "b.exr"], np.full((32, 48, 3), 0.2, np.float32))
    save_gaussians(tmp_path / "a.ply", SplatFile(some_gaussians(50)))
    client, served = FakeClient(1, PHOTO), []

    @contextmanager
    def serve(*arguments):
        with server.Viewer(*arguments) as viewer:
            viewer.server.enter(client)
            served.append(viewer.watchers[1].camera(MOST)[0])
            drawn(viewer)
            yield viewer

    monkeypatch.setattr("warp_splat.viewer.command.Viewer", serve)
    monkeypatch.setattr("warp_splat.viewer.command.interruptible", lambda: nullcontext([2]))
    at_rest(monkeypatch)
    assert view_model(ViewConfig(str(tmp_path / "a.ply"), str(root) if source else "")) == 0
    draw = make_renderer(GaussianModel.from_splats(some_gaussians(50)).arranged(), False, RasterOptions())
    plain = draw(served[0], False).image.clamp(0, 1)
    assert plain.std() > 0.1
    shown = to_srgb(plain, torch.where) if source else plain
    np.testing.assert_array_equal(client.frames[-1][0], np.rint(255 * shown.numpy()))


def watch_training(trainer, run):
    viewer = server.Viewer(trainer.look, lambda: trainer.model.parameters["means"], trainer.scene, 8080)
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

        def wait(seconds):
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
    monkeypatch.setattr(viewer, "wait", lambda seconds: interrupted.append(2))
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
    root = write_colmap(folder / "scene")
    (root / "sparse" / "0" / "points3D.txt").write_text("# none\n")
    monkeypatch.setattr(sys.modules["viser"], "ViserServer", Visited)
    monkeypatch.setattr(server, "DESERTED", 0.0)
    monkeypatch.setattr("warp_splat.training.live.REFRESH", 0.0)
    monkeypatch.setattr("warp_splat.training.live.SHARE", 1e9)
    monkeypatch.setattr(server.Viewer, "wait", lambda viewer, seconds: viewer.server.wait())
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
