"""Photographs within a bound of memory: the same bytes of the model as with all of them in memory."""

import threading
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from commands import train
from scene_files import texture, write_colmap, write_image
from trainings import begin, check_same, resumed, stepped, steps

from warp_splat.cli import main
from warp_splat.errors import InputError
from warp_splat.evaluation.metrics import METRICS
from warp_splat.evaluation.views import evaluate_views, show_views
from warp_splat.formats.model_folder import ply_path
from warp_splat.scene import decoding, load_scene
from warp_splat.scene.decoding import in_turn
from warp_splat.scene.embedded import embedded_scene
from warp_splat.scene.types import View
from warp_splat.training.photographs import Deck, PhotoFile, Photograph

SIZE = 3 * 33 * 31  # bytes of a photograph


@pytest.fixture(scope="module")
def bounded():
    """Scenes that keep nothing, and about a third of their photographs."""
    limits = [1.0, (decoding.AHEAD + decoding.RECENT + 15) * SIZE]
    return [load_scene(embedded_scene(), resolution=8, memory=limit, report=str) for limit in limits]


@pytest.mark.parametrize(
    "options",
    [pytest.param({"coarse": 4, "coarse_until_iter": 30}, marks=pytest.mark.slow), {"parts": "exposure,background"}],
    ids=str,
)
def test_a_bound_changes_no_byte(options, scene, bounded, tmp_path):
    whole = stepped(scene, tmp_path, 36, **options)
    for limited in bounded:
        assert limited.memory.limit < SIZE * len(scene.train)
        trainer, other = begin(limited, tmp_path, **options)
        steps(trainer, other, 36, lambda t=trainer: check_kept(t))
        check_same((trainer, other), whole)
    check_same(resumed(bounded[1], tmp_path / "resumed", (20, 36), then=scene, **options), whole)


@pytest.mark.slow
@pytest.mark.parametrize("fit", [10**9, 20])
def test_what_does_not_fit_is_decoded_once_while_the_disk_has_room(scene, bounded, tmp_path, monkeypatch, fit):
    """A header of 128 bytes is before each."""
    room = 2 * fit * (SIZE + 128)
    whole, decoded, pixels = stepped(scene, tmp_path, 2 * len(scene.train)), Counter(), View.pixels.fget
    monkeypatch.setattr(View, "pixels", property(lambda view: decoded.update([view.name]) or pixels(view)))
    trainer, run = begin(bounded[0], tmp_path, model_path=str(tmp_path))
    file = trainer.photographs._file
    monkeypatch.setattr(file, "_spared", room / 2)
    taken = lambda _: SimpleNamespace(free=room - file._file.seek(0, 2))  # noqa: E731
    monkeypatch.setattr("warp_splat.training.photographs.shutil.disk_usage", taken)
    steps(trainer, run, 2 * len(scene.train))
    check_same((trainer, run), whole)
    once = sum(count == 1 for count in decoded.values())
    assert once == min(fit, len(scene.train))


def test_a_photograph_whose_end_finds_no_room_is_not_kept(tmp_path):
    """And what is written after it is whole."""
    file, random = PhotoFile(tmp_path), np.random.default_rng(0)
    made = [Photograph(torch.tensor(random.integers(0, 255, (9, 7, 3), np.uint8)), None, None) for _ in range(6)]
    raw = file._file
    for index, each in enumerate(made):
        cut = SimpleNamespace(seek=raw.seek, write=lambda content: raw.write(content[:150]))
        file._file = cut if index % 2 else raw
        file.write(each, 1, each)
    file._file = raw
    for index, each in enumerate(made):
        found = file.read(each, 1)
        assert found is None if index % 2 else torch.equal(found.image, each.image)


def check_kept(trainer):
    kept = sum(plane.nbytes for p in trainer.photographs.kept.values() for plane in p if plane is not None)
    assert kept <= trainer.scene.memory.limit and len(trainer.photographs._coming) <= decoding.AHEAD


def test_all_but_the_first_are_decoded_ahead(scene, bounded, tmp_path, monkeypatch):
    """By threads, which never stop to, in each size; nothing that has come is read again."""
    pixels, places = View.pixels.fget, Counter()

    def counted(view):
        places[threading.current_thread() is threading.main_thread()] += 1
        return pixels(view)

    monkeypatch.setattr(View, "pixels", property(counted))
    trainer, run = begin(bounded[0], tmp_path, coarse=2, coarse_until_iter=30)
    steps(trainer, run, 60)
    assert places[True] <= 2 and places[False] <= 60 + 2 * decoding.AHEAD


def test_what_comes_is_what_is_dealt(scene):
    for count in (1, 3):
        deck = Deck(scene.train, 7)
        for _ in range(60):
            before = deck.state()
            coming = deck.coming(count, 3)
            assert deck.state() == before and deck.deal(count) == coming[0]


def test_every_kind_of_file_is_read_alike(tmp_path, monkeypatch):
    """Color, gray, alpha, 16 bits, masks; as they are and shrunk, plain bytes and through floats."""
    kinds = {"a.png": (3, np.uint8), "b.png": (4, np.uint8), "c.png": (1, np.uint8), "d.png": (3, np.uint16)}
    root = write_colmap(tmp_path / "scene", [*kinds, "e.jpg"])
    for name, (channels, dtype) in kinds.items():
        write_image(root / "images" / name, texture(channels=channels, dtype=dtype))
    write_image(root / "masks" / "b.png.png", np.repeat(np.eye(32, 48, dtype=np.uint8)[..., None] * 255, 3, 2))
    for resolution in (1, 2):
        scenes = [load_scene(root, resolution=resolution, memory=memory, report=str) for memory in (None, 1e9, 1.0)]
        monkeypatch.setattr("warp_splat.scene.images._read_plain", lambda *_: None)
        scenes.append(load_scene(root, resolution=resolution, report=str))
        monkeypatch.undo()
        for views in zip(*(scene.train for scene in scenes), strict=True):
            for name in ("image", "alpha", "mask"):
                planes = [getattr(view, name) for view in views]
                assert all((p is None and planes[0] is None) or np.array_equal(p, planes[0]) for p in planes)


def test_views_in_turn_are_those_of_the_scene_and_nothing_stays(scene, bounded):
    for view, one in zip(scene.train, in_turn(bounded[0].train), strict=True):
        assert one.name == view.name and np.array_equal(one.picture, view.picture)
    first = bounded[0].train[0]
    assert first.pixels is first.pixels and bounded[0].train[9].pixels is not None
    many = [view.pixels for view in bounded[0].train[:5]]
    assert first.pixels is not many[0]  # it was let go


def test_evaluation_is_the_same(scene, bounded, tmp_path):
    trainer, _ = stepped(scene, tmp_path, 3)
    written = []
    for place, views in enumerate((scene.train[:9], bounded[0].train[:9])):
        folder = tmp_path / str(place)
        _, compared = evaluate_views(trainer.picture, views, folder, "train", 3, {}, METRICS)
        show_views(compared, folder, "train", 3, str)
        assert trainer.evaluate(views) == pytest.approx(np.mean([c.values["PSNR"] for c in compared]))
        written.append({path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()})
    assert written[0] == written[1] and len(written[0]) == 22


def test_a_photograph_that_breaks_off_ends_a_training_that_is_kept(tmp_path, capsys):
    """Its header is whole, so it is found when its turn comes."""
    root = write_colmap(tmp_path / "scene", [f"{index}.jpg" for index in range(6)])
    broken = root / "images" / "3.jpg"
    broken.write_bytes(broken.read_bytes()[:-900])
    lazily = load_scene(root, memory=1.0, report=str)
    with pytest.raises(InputError, match=r"3\.jpg: expected a complete image file"):
        _ = lazily.train[3].image
    options = ["-s", str(root), "--photo_memory", "1e-6", "--iterations", "12"]
    assert train(tmp_path / "model", *options) == 1
    said = capsys.readouterr()
    assert "3.jpg: expected a complete image file" in said.err and "Model after" in said.out
    assert ply_path(tmp_path / "model", int(said.out.split("Model after ")[1].split()[0])).is_file()


def test_a_held_out_photograph_that_breaks_off_loses_no_step(tmp_path, capsys):
    root = write_colmap(tmp_path / "scene", [f"{index}.jpg" for index in range(6)])
    broken, model = root / "images" / "0.jpg", tmp_path / "model"
    whole = broken.read_bytes()
    broken.write_bytes(whole[:-900])
    options = ["-s", str(root), "--photo_memory", "1e-6", "--iterations", "12", "--test_iterations", "5"]
    assert train(model, *options) == 1 and "continue after iteration 5" in capsys.readouterr().out
    broken.write_bytes(whole)
    assert main(["train", "--resume", str(model)]) == 0 == train(tmp_path / "again", *options)
    assert ply_path(model, 12).read_bytes() == ply_path(tmp_path / "again", 12).read_bytes()
