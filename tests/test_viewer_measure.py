"""Measuring in the viewer: clicked points against where Gaussians are, by every kind of lens; a box as a flag."""

import asyncio
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fake_viser import PHOTO, at_rest, drawn, entered
from splat_files import some_splats

from warp_splat.gaussians import GaussianModel
from warp_splat.lenses import Lens
from warp_splat.rendering.finished import make_renderer
from warp_splat.viewer import server
from warp_splat.viewer.measure import point_at

PLACES = np.array([[-0.6, 0.3, 0.2], [0.5, -0.4, -0.9]])  # world, on both sides of the picture
LENSES = (None, Lens("OPENCV", (-0.1, 0.01, 0.002, -0.001)), Lens("OPENCV_FISHEYE", (0.01, -0.003, 0.0, 0.0)))


@pytest.fixture
def draw():
    """Draws two small opaque balls."""
    balls = some_splats(2)._replace(means=np.float32(PLACES))
    scales, opacities = np.full_like(balls.scales, np.log(0.05)), np.full_like(balls.opacities, 6.0)
    return make_renderer(GaussianModel.from_splats(balls._replace(scales=scales, opacities=opacities)))


def places_of(camera):
    seen = camera.pixels(PLACES @ camera.rotation.T + camera.translation)
    return seen / (camera.width, camera.height)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model if lens else "pinhole")
def test_a_click_finds_what_it_shows(draw, lens):
    camera = replace(PHOTO, lens=lens)
    found = [point_at(draw, camera, place) for place in places_of(camera)]
    np.testing.assert_allclose(found, PLACES, atol=2e-3)
    assert point_at(draw, camera, (0.02, 0.02)) is None


def test_a_click_has_the_depth_of_its_own_pixel(draw):
    """To the last pixel of a ball."""
    depth = draw(PHOTO, median=True).median_depth.numpy()
    x, y = (places_of(PHOTO)[0] * (PHOTO.width, PHOTO.height)).astype(int)
    places = [(x + dx, y + dy) for dx in range(-14, 15, 2) for dy in range(-14, 15, 2)]
    found = [point_at(draw, PHOTO, ((x + 0.5) / PHOTO.width, (y + 0.5) / PHOTO.height)) for x, y in places]
    shown = [depth[y, x] > 0 for x, y in places]
    assert [point is not None for point in found] == shown and len(set(shown)) == 2


def test_two_clicks_are_a_distance_and_two_corners_a_box(draw, fake_viser, monkeypatch):
    at_rest(monkeypatch)
    model = GaussianModel.from_splats(some_splats(2)._replace(means=np.float32(PLACES)))
    with server.Viewer(draw, model, None, 8080) as viewer:
        client = entered(viewer, PHOTO, (600, 400))
        ruler = viewer.watchers[1].ruler
        camera = viewer.watchers[1].camera(1e9)[0]
        ruler.measuring.value = True
        click = client.scene.on_click.return_value.call_args.args[0]
        for place in ((0.01, 0.01), *places_of(camera)):  # the first on nothing
            click(SimpleNamespace(screen_pos=tuple(place)))
        assert drawn(viewer) == 1
        assert float(ruler.note.content) == pytest.approx(np.linalg.norm(PLACES[1] - PLACES[0]), rel=2e-3)
        click(SimpleNamespace(screen_pos=tuple(places_of(camera)[0])))  # begins anew
        drawn(viewer)
        np.testing.assert_allclose([float(value) for value in ruler.note.content.split()], PLACES[0], atol=2e-3)
        ruler.measuring.value = False
        assert client.scene.remove_click_callback.called

        client.scene.add_transform_controls.side_effect = lambda name, position, **_: SimpleNamespace(
            position=position, on_update=lambda handler: setattr(ruler, "dragged", handler)
        )
        ruler.boxed.value = True
        ruler.corners[0].position, ruler.corners[1].position = np.array([[1234.56, -2.0, 3.0], [0.0, 5.0, -4.0]])
        asyncio.run(ruler.dragged(None))
        assert ruler.note.content == "`--crop 0 -2 -4 1234.56 5 3`"
        ruler.boxed.value = False
        assert not ruler.note.content
        asyncio.run(ruler.dragged(None))  # by a message that was on its way
        assert not ruler.note.content
        for control in (ruler.measuring, ruler.boxed):  # the rest runs in threads, where the next switch may be sooner
            assert all(map(asyncio.iscoroutinefunction, control.handlers))
