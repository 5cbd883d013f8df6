"""The handlers of the viewer, with the place of browsers taken by a fake."""

import socket
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest
import torch
from fake_viser import PHOTO, FakeClient, at_rest, drawn, entered, some_scene, wxyz
from hostile import refusal
from scene_files import write_colmap
from splat_files import small_splats

from warp_splat.color import to_srgb
from warp_splat.config import RasterOptions, ViewConfig
from warp_splat.errors import InputError
from warp_splat.formats.exchange import save_gaussians
from warp_splat.formats.splats import SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.finished import make_renderer
from warp_splat.scene.types import Stored
from warp_splat.viewer import server
from warp_splat.viewer.command import view_model
from warp_splat.viewer.watcher import MOST


@pytest.fixture
def viewer(fake_viser):
    model, scene = GaussianModel.from_splats(small_splats(50)), some_scene()
    draw = make_renderer(model)
    with server.Viewer(draw, model, scene, 8080) as viewer:
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
    client = entered(viewer, size=(960, 640))
    viewer.watchers[1].pixels = 96 * 64
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
    client = entered(viewer, size=(120, 60))
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


def test_a_photograph_that_cannot_be_read_is_told_and_ends_nothing(viewer, monkeypatch):
    at_rest(monkeypatch)
    client, looks = entered(viewer, size=(120, 60)), viewer.watchers[1]

    def read():
        raise InputError("0.png: expected a complete image file, found none.")

    viewer.views["0.png"] = replace(viewer.views["0.png"], photograph=Stored(read, False, False, False))
    looks.opacity.value = 1.0
    looks.steps.call(value="next")
    assert drawn(viewer) >= 1 and "complete image file" in looks.note.content
    looks.steps.call(value="next")
    assert drawn(viewer) >= 1 and client.frames and "complete image file" not in looks.note.content


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (InputError("rasterize: too many tiles; take fewer."), "too many tiles"),
        (MemoryError(), "Out of memory on cpu"),
        (torch.OutOfMemoryError("CUDA"), "Out of memory on cpu"),
    ],
)
def test_a_frame_that_cannot_be_drawn_is_told_and_ends_nothing(viewer, monkeypatch, error, told):
    at_rest(monkeypatch)
    client, looks, draw = entered(viewer, size=(120, 60)), viewer.watchers[1], viewer.draw_camera

    def fail(*_, **__):
        raise error

    viewer.draw_camera = fail
    assert drawn(viewer) == 1 and not client.frames
    assert told in looks.note.content
    refusal(lambda: server.Viewer(fail, viewer.model, None, 8080), told)
    viewer.draw_camera = draw
    viewer.refresh()
    assert drawn(viewer) == 1 and client.frames


def picture_of(viewer, camera):
    image = viewer.draw_camera(camera, False).image
    return (image.clamp(0, 1) * 255).round().byte().numpy()


def test_kinds_of_frames(viewer, monkeypatch):
    at_rest(monkeypatch)
    client = entered(viewer, some_scene().train[0].camera)
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
    client = entered(viewer)
    draw = viewer.draw_camera

    def leave(camera, depth):
        viewer.server.leave(client)
        return draw(camera, depth)

    viewer.draw_camera = leave
    assert drawn(viewer) == 1 and client.frames == []


@pytest.mark.parametrize("size", [(0, 0), (60_000, 60_000), (70_000, 2)])
def test_windows_of_strange_sizes(viewer, monkeypatch, size):
    at_rest(monkeypatch)
    client = entered(viewer, size=size)
    assert drawn(viewer) == 1
    assert [frame.shape[0] * frame.shape[1] <= MOST for frame, _ in client.frames] == [True] * (0 < size[0] < 65_000)


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("coefficients", [1, 16])
def test_small_models(fake_viser, count, coefficients):
    """Also an empty one, and one without spherical harmonics."""
    model = GaussianModel.from_splats(small_splats(count, coefficients))
    draw = make_renderer(model)
    with server.Viewer(draw, model, None, 8080) as viewer:
        client = entered(viewer)
        for kind in ("image", "depth", "alpha"):
            viewer.watchers[1].kind.value = kind
            assert drawn(viewer) == 1
        assert len(client.frames) == 3


def test_no_model_is_refused():
    refusal(lambda: view_model(ViewConfig()), "MODEL: expected the folder")


@pytest.mark.parametrize(("source", "tolerance"), [("", 0.0), ("scene", 0.0), ("", 0.5)])
def test_a_file_of_a_scene_in_linear_light(fake_viser, monkeypatch, tmp_path, source, tolerance):
    """A file does not say what light it was trained in; its scene does."""
    root = write_colmap(tmp_path / "scene", ["a.exr", "b.exr"], np.full((32, 48, 3), 0.2, np.float32))
    save_gaussians(tmp_path / "a.ply", SplatFile(small_splats(200)))
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
    assert view_model(ViewConfig(str(tmp_path / "a.ply"), str(root) if source else "", tolerance=tolerance)) == 0
    options = RasterOptions(tolerance=tolerance or None, of="trained")
    draw = make_renderer(GaussianModel.from_splats(small_splats(200)).arranged(), None, options)
    plain = draw(served[0], False).image.clamp(0, 1)
    assert plain.std() > 0.1
    shown = to_srgb(plain, torch.where) if source else plain
    np.testing.assert_array_equal(client.frames[-1][0], np.rint(255 * shown.numpy()))
