"""A photograph's own exposure where its camera is shown: by render.py and in the viewer; neutral ones elsewhere."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_viser import FakeClient, at_rest, drawn, some_gaussians, some_scene
from test_checkpoints import begin, steps
from test_train import fails, train

from warp_splat.cli import main
from warp_splat.config import RasterOptions
from warp_splat.formats.model_folder import open_model
from warp_splat.formats.png import load_png
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.command import make_renderer
from warp_splat.rendering.own_exposure import own_exposure
from warp_splat.viewer import server

MAP = [[0.5, 0.1, 0.0, 0.02], [0.0, 0.8, 0.0, -0.01], [0.2, 0.0, 1.5, 0.0]]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A model whose first photograph, which is held out, and second one have MAP."""
    folder = tmp_path_factory.mktemp("model")
    assert train(folder, "--iterations", "6", "-r", "8", "--parts", "exposure") == 0
    maps = json.loads((folder / "exposure.json").read_text())
    assert "view_000.png" not in maps and len(maps) == 43
    (folder / "exposure.json").write_text(json.dumps(maps | {"view_001.png": MAP}))
    return folder


def test_render_shows_training_photographs_as_they_were_taken(trained, capsys):
    """By ``color @ map[:, :3] + map[:, 3]`` in float64; held-out ones, and other photographs, hardly change."""
    assert main(["render", "-m", str(trained)]) == 0
    renders = [load_png(trained / "train" / "ours_6" / "renders" / f"{place:05d}.png") for place in (0, 1)]
    (trained / "exposure.json").rename(trained / "away.json")
    assert main(["render", "-m", str(trained)]) == 0
    neutral = [load_png(trained / "train" / "ours_6" / "renders" / f"{place:05d}.png") for place in (0, 1)]
    (trained / "away.json").rename(trained / "exposure.json")
    expected = neutral[0] / 255 @ np.array(MAP)[:, :3] + np.array(MAP)[:, 3]
    assert np.abs(renders[0] / 255 - expected.clip(0, 1)).max() < 1.5 / 255
    assert np.abs(renders[1].astype(int) - neutral[1]).max() <= 6 and not np.array_equal(renders[0], neutral[0])


def test_maps_are_those_of_the_last_iteration_of_a_folder(trained):
    iteration, _, options = open_model(trained)
    image, shown = torch.rand(3, 4, 3), lambda *where: own_exposure(*where)(image, "view_001.png")
    assert not torch.equal(shown(str(trained), iteration, options), image)
    assert own_exposure(str(trained), iteration, options)(image, "view_000.png") is image
    for others in ((str(trained), iteration - 1, options), (str(trained), iteration, {**options, "parts": ""})):
        assert shown(*others) is image


@pytest.mark.parametrize("text", ["{", "[]", '{"a.png": [[1, 2]]}', '{"a.png": "x"}', '{"a.png": [1, [2]]}'])
def test_damaged_maps_are_one_sentence(text, trained, capsys):
    whole = (trained / "exposure.json").read_text()
    (trained / "exposure.json").write_text(text)
    assert "exposure.json: " in fails(capsys, "render", "-m", str(trained))
    (trained / "exposure.json").write_text(whole)


def test_the_viewer_shows_it_within_the_photograph(fake_viser, monkeypatch):
    at_rest(monkeypatch)
    model, client = GaussianModel.from_splats(some_gaussians(50)), FakeClient(1, some_scene().test[0].camera, (120, 60))
    draw, frames = make_renderer(model, False, RasterOptions()), []
    for factor in (1.0, 0.25):
        exposed = lambda image, view, factor=factor: image * factor  # noqa: E731
        with server.Viewer(draw, lambda: model.parameters["means"], some_scene(), 8080, exposed=exposed) as viewer:
            client = FakeClient(1, some_scene().train[1].camera, size=(120, 60))
            viewer.server.enter(client)
            drawn(viewer)
            free = client.frames[-1][0]
            viewer.watchers[1].view.value = "0.png"
            drawn(viewer)
            frames.append((free, client.frames[-1][0]))
    (free, one), (free_again, other) = frames
    assert np.array_equal(free, free_again)
    assert np.array_equal(one[:, :30], other[:, :30]) and np.array_equal(one[:, 90:], other[:, 90:])
    assert one[:, 30:90].any() and np.abs(0.25 * one[:, 30:90] - other[:, 30:90]).max() <= 1


@pytest.mark.parametrize("options", [{"exposure": "affine"}, {"exposure": "gain", "vignetting": True}], ids=str)
def test_training_shows_what_it_compares(options, scene, tmp_path):
    trainer, run = begin(scene, tmp_path, **options)
    steps(trainer, run, 12)
    view, (part,) = scene.train[3], trainer.parts
    image = trainer.look(view.camera).image
    step = type("", (), {"view": view})
    assert torch.equal(part.as_taken(image, view), part.image(image, None, step).detach())
    assert part.as_taken(image, replace(view, name="another")) is image
