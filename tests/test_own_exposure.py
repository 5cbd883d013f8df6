"""A photograph's own exposure where its camera is shown: by render.py and in the viewer; neutral ones elsewhere."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fake_viser import FakeClient, at_rest, drawn, some_gaussians, some_scene
from test_checkpoints import begin, steps
from test_train import fails, train

from warp_splat.cli import main
from warp_splat.config import RasterOptions
from warp_splat.formats.exposures import read_exposures
from warp_splat.formats.png import load_png
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.command import make_renderer
from warp_splat.rendering.photographed import as_photographed
from warp_splat.viewer import server


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A model, and its file of exposures, where the second photograph that trains has a gain of 1.5."""
    folder = tmp_path_factory.mktemp("model")
    assert train(folder, "--iterations", "6", "-r", "8", "--parts", "exposure") == 0
    file = folder / "point_cloud" / "iteration_6" / "exposures.json"
    facts = json.loads(file.read_text())
    assert len(facts["maps"]) == 50
    facts["maps"] = {name: [0.5] if name == "view_002.png" else [0.0] for name in facts["maps"]}
    file.write_text(json.dumps(facts))
    return folder, file


def test_render_shows_photographs_as_they_were_taken(trained):
    """By a gain on value + 0.055 in float64; and as the mean photograph where there is no file."""
    (folder, file), written = trained, []
    for name in ("exposures.json", "away.json"):
        file.rename(file.with_name(name))
        assert main(["render", "-m", str(folder)]) == 0
        written.append([load_png(folder / f"train/ours_6/renders/{place:05d}.png") for place in (0, 1)])
        file.with_name(name).rename(file)
    renders, neutral = written
    expected = 1.5 * (neutral[1] / 255 + 0.055) - 0.055
    assert np.abs(renders[1] / 255 - expected.clip(0, 1)).max() < 1.5 / 255
    assert np.array_equal(renders[0], neutral[0])


def test_exposures_are_those_beside_the_gaussians(trained):
    folder, file = trained
    assert read_exposures(folder, 6) and not read_exposures(folder, 5)
    assert read_exposures(file.parent / "point_cloud.ply", 0)


@pytest.mark.parametrize(
    "changes",
    ["{", "[]", {"kind": "else"}, {"maps": {"a": [1, 2]}}, {"maps": [1]}, {"falloff": [1e999, 0]}, {"pivot": "x"}],
    ids=str,
)
def test_damaged_exposures_are_one_sentence(changes, trained, capsys):
    folder, file = trained
    whole = file.read_text()
    file.write_text(changes if isinstance(changes, str) else json.dumps(json.loads(whole) | changes))
    assert "exposures.json: expected exposures as training writes them" in fails(capsys, "render", "-m", str(folder))
    file.write_text(whole)


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
    image, exposures = trainer.look(view.camera).image, trainer.exposures
    expected = part.image(image, None, SimpleNamespace(view=view)).detach()
    assert torch.equal(as_photographed(image, exposures, view.name), expected)
    assert as_photographed(image, exposures, "another") is image
