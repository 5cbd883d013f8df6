"""Blocks of a scene: every place has one owner, photographs go where they look, and a merge is what its parts were."""

import json
import shutil

import numpy as np
import pytest
from commands import SCENE, SHORT, interrupt, no_space, train
from hostile import refusal, replace
from scene_files import LENS, texture, write_image

from warp_splat.camera import Camera
from warp_splat.cli import main
from warp_splat.formats.checkpoint import LAST, load_checkpoint
from warp_splat.formats.coordinates import write_coordinates
from warp_splat.formats.exchange import load_gaussians, save_gaussians
from warp_splat.formats.model_folder import ply_path
from warp_splat.formats.ply import save_points
from warp_splat.formats.splats import SplatFile
from warp_splat.gaussians import GaussianModel
from warp_splat.rendering.finished import Finished
from warp_splat.scene import load_scene
from warp_splat.scene.blocks import BLOCK, block_of
from warp_splat.training.options import TrainConfig

APART = 100.0


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8])
def test_each_place_has_one_owner_and_each_block_its_share(count):
    random = np.random.default_rng(0)
    points = random.normal(size=(10_000, 3)) * (30, 1, 9)
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0, np.eye(3), np.zeros(3))
    blocks = [block_of(f"{number + 1}/{count}", points, [camera]) for number in range(count)]
    places = np.concatenate([points, random.uniform(-1e6, 1e6, (10_000, 3)), blocks[0].cells.reshape(-1, 3)])
    places = places[np.abs(places).max(1) < 1e30]
    assert (sum(block.holds(places).astype(int) for block in blocks) == 1).all()
    shares = [block.holds(points).mean() for block in blocks]
    np.testing.assert_allclose(shares, 1 / count, atol=1e-3)
    up = blocks[0].cells[:, :, 1]  # y, as the camera says: nobody cuts there
    assert len(np.unique(up)) == 2


def test_what_is_seen_from_above_is_cut_along_the_ground():
    """Where coordinates say that y is down, whatever cameras take for up."""
    points = np.random.default_rng(0).uniform(-1, 1, (10_000, 3)) * (100, 2, 1000)
    down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    cells = block_of("1/4", points, [Camera(8, 8, 8.0, 8.0, 4.0, 4.0, down, np.zeros(3))], True).cells
    np.testing.assert_allclose(np.sort(cells[:, 1, 2])[:-1], (-500, 0, 500), atol=50)  # across the longer side


@pytest.fixture
def two_things(tmp_path):
    """Two clouds of points far apart, three photographs of each, and one between them that shows the second one."""
    cloud = np.random.default_rng(0).uniform(-1, 1, (60, 3))
    frames = []
    for index, x in enumerate((0, 0, 0, APART, APART, APART, 0.6 * APART)):
        matrix = np.eye(4)  # of OpenGL: it looks along -z
        matrix[:3, 3] = x + 0.1 * index, 0, 6
        if index == 6:
            matrix[:3, :3], matrix[:3, 3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]], (0.6 * APART, 0, 0)
        frames.append({"file_path": f"{index}.png", "transform_matrix": matrix.tolist()})
        write_image(tmp_path / f"{index}.png", texture())
    points = np.concatenate([cloud, cloud + np.array((APART, 0, 0))]).astype(np.float32)
    save_points(tmp_path / "points.ply", points, np.zeros(points.shape, np.uint8))
    (tmp_path / "transforms.json").write_text(json.dumps({**LENS, "ply_file_path": "points.ply", "frames": frames}))
    return tmp_path, points


def test_a_block_has_what_shows_it(two_things):
    folder, points = two_things
    for block, names, own in (("1/2", "012", points[:60]), ("2/2", "3456", points[60:])):
        scene = load_scene(folder, block=block)
        assert [view.name for view in scene.train] == [f"{name}.png" for name in names]
        np.testing.assert_array_equal(scene.points, own)


@pytest.mark.parametrize("block", ["0/2", "3/2", "2", "a/b", "1/2/3", "-1/2", "/2", "1/1000", "2/100"])
def test_a_block_that_cannot_be_is_refused(two_things, block):
    refusal(lambda: load_scene(two_things[0], block=block), match=f"--block {block}: expected")


def test_a_block_that_no_photograph_shows_is_found_before_another_trains(tmp_path, fails):
    """But what was trained can be looked at."""
    words = "train", "-s", SCENE, "-m", tmp_path, *SHORT
    assert "found none of block 1; take fewer blocks" in fails(*words, "--block", "2/24")
    assert "--block 1/24: expected photographs that show it" in fails(*words, "--blocks", "24")
    assert load_scene(SCENE, block="2/24", report=str).train


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A training of the first of two blocks, to its end."""
    folder = tmp_path_factory.mktemp("blocks") / "one"
    assert train(folder, "--block", "1/2") == 0
    return folder


def test_a_block_whose_model_is_elsewhere_has_not_ended(tmp_path, capsys):
    """As where the disk is full: the next run saves it again."""
    (tmp_path / "point_cloud").mkdir()
    (tmp_path / "point_cloud/iteration_5").write_text("in the way")
    assert train(tmp_path, "--block", "1/2", "--iterations", "5", "--no-eval") == 1
    assert "is not in" in capsys.readouterr().err and not (tmp_path / BLOCK).exists()


@pytest.mark.slow
def test_a_budget_is_a_blocks_own(tmp_path, ran):
    """Together they are more."""
    words = "train", "-s", SCENE, "-m", tmp_path, "-r", "8", "--iterations", "20", "--blocks", "4"
    ran(*words, "--growth", "mcmc", "--max_gaussians", "2600")
    assert len(load_gaussians(ply_path(tmp_path / "together", 20)).splats.means) > 2600


@pytest.mark.parametrize(("name", "other"), [("optimizer_type", "sparse_adam"), ("growth", "mcmc")])
def test_a_block_half_trained_keeps_its_kind(tmp_path, monkeypatch, fails, name, other):
    words = "train", "-s", SCENE, "-m", tmp_path, "-r", "8", "--iterations", "9", "--blocks", "2", "--quiet"
    with monkeypatch.context() as patch:
        interrupt(patch, 1)
        assert main([*map(str, words)]) == 130
    more = ("--max_gaussians", 9000) * (name == "growth")
    assert f"--{name} {other}: expected {TrainConfig().flat()[name]}, as in" in fails(*words, f"--{name}", other, *more)


def test_a_block_is_that_of_what_it_started_from(tmp_path, fails):
    """Where its views are drawn, and where it goes on; not that of the scene's own points."""
    random, folder = np.random.default_rng(0), tmp_path / "model"
    means = np.concatenate([load_scene(SCENE, report=str).points[:40], random.normal((9, 0, 0), 0.1, (400, 3))])
    splats = GaussianModel.from_points(means.astype(np.float32), np.zeros(means.shape, np.uint8), 0).splats()
    save_gaussians(tmp_path / "start.ply", SplatFile(splats))
    words = "--block", "1/2", "--start_ply", str(tmp_path / "start.ply"), "--iterations", "2", "--no-eval"
    assert train(folder, *words) == 0
    views = [view.name for view in Finished(folder).load_scene("", str).train]
    assert views == load_checkpoint(folder).facts["views"]
    (tmp_path / "start.ply").unlink()
    said = []
    Finished(folder).load_scene("", said.append)
    assert any("start.ply, which the block started from, has gone" in sentence for sentence in said)
    assert "start.ply" in fails("train", "--resume", folder, "--iterations", "4")


def put(trained, folder, *numbers):
    """Trainings of blocks with the model of another."""
    for number in numbers:
        shutil.copytree(trained, folder / str(number))
        facts = json.loads((trained / BLOCK).read_text())
        (folder / str(number) / BLOCK).write_text(json.dumps({**facts, "number": int(number)}))


@pytest.mark.slow
def test_a_merge_of_one_model_by_blocks_is_that_model(trained, tmp_path, capsys):
    """Whatever the cells are: nothing is lost, nothing comes twice. And render.py knows what to compare it with."""
    put(trained, tmp_path, 0, 1)
    for _ in range(2):  # again, after one block was trained anew
        assert main(["merge", str(tmp_path)]) == 0
    (ply,), (one,) = (list(place.glob("point_cloud/*/point_cloud.ply")) for place in (tmp_path, trained))
    assert ply.read_bytes() == one.read_bytes()
    cameras = [json.loads((place / "cameras.json").read_text()) for place in (tmp_path, trained)]
    assert len(cameras[0]) == len(cameras[1]) == len(list((SCENE / "images").iterdir()))
    assert main(["render", "-m", str(tmp_path), "--skip_train"]) == 0
    assert "Holding out every 8th image by name" in capsys.readouterr().out
    spoil('"view_000.png"', "0", "cameras.json")(tmp_path)
    assert main(["merge", str(tmp_path)]) == 0  # a number is a name as well


def spoil(old, new, name=BLOCK):
    return lambda folder: replace(folder / "1" / name, old.encode(), new.encode())


#: What a merge finds: the numbers of the blocks, where they are not 0 and 1, and what is wrong with these.
NUMBERS = {"found none": (), "found 0 of block 2/2": (0,), "found 2 of block 1/2, 0 of block 2/2": (0, "00")}
WRONG = {
    "found another model": lambda folder: (folder / LAST).touch(),
    "trainings by --block, found another": lambda folder: (folder / "1/point_cloud").rename(folder / "point_cloud"),
    "expected the number of blocks of": spoil('"cells": [', '"cells": [[[0, 0, 0], [1, 1, 1]], '),
    "expected the cells of": spoil("3.4", "3.1"),
    "expected the antialiasing of": spoil("antialiasing=False", "antialiasing=True", "cfg_args"),
    "expected the linear_light of": spoil("linear_light=False", "linear_light=True", "cfg_args"),
    "expected the sh_degree of": spoil("sh_degree=3", "sh_degree=2", "cfg_args"),
    "expected the eval of": spoil("eval=True", "eval=False", "cfg_args"),
    "expected the origin of": lambda folder: write_coordinates(folder / "1", {"origin": [1.0, 2.0, 3.0]}),
    "cfg_args: could not be read (No such file or directory)": lambda folder: (folder / "1" / "cfg_args").unlink(),
    "expected a block as training writes it": spoil('"number"', '"numbers"'),
    "expected cameras as training writes them": spoil('"img_name"', '"image"', "cameras.json"),
}


@pytest.mark.parametrize("found", [*NUMBERS, *WRONG])
def test_a_merge_says_what_is_wrong(found, trained, tmp_path, fails):
    put(trained, tmp_path, *NUMBERS.get(found, (0, 1)))
    if found in WRONG:
        WRONG[found](tmp_path)
    assert found in fails("merge", tmp_path)


def test_no_gaussians_are_merged_without_what_they_are_drawn_with(trained, tmp_path, fails, monkeypatch):
    """Neither new ones nor, with what new ones are drawn with, those merged before."""
    put(trained, tmp_path, 0, 1)
    monkeypatch.setattr("warp_splat.scene.blocks.write_coordinates", no_space)
    assert "no space left" in fails("merge", tmp_path)
    assert not list(tmp_path.glob("point_cloud/*/*"))
    monkeypatch.undo()
    assert main(["merge", str(tmp_path)]) == 0
    monkeypatch.setattr("warp_splat.scene.blocks.save_gaussians", no_space)
    assert "no space left" in fails("merge", tmp_path)
    assert not list(tmp_path.glob("point_cloud/*/*"))


def test_blocks_are_not_trained_where_another_model_is(trained, tmp_path, fails):
    """Also one without a checkpoint."""
    ply = shutil.copytree(trained / "point_cloud", tmp_path / "point_cloud")
    words = "train", "-s", SCENE, "-m", tmp_path, *SHORT, "--blocks", "2"
    assert "it already holds another model; move it away" in fails(*words)
    assert list(ply.glob("*/*.ply"))


@pytest.mark.slow
def test_all_blocks_by_one_command_are_those_of_many(trained, tmp_path, capsys, monkeypatch, fails):
    """Stopped within the second block, and gone on with; a block that has ended is not trained again."""
    put(trained, tmp_path, 0)
    (tmp_path / "0").rename(tmp_path / "1")
    all_of_it, place = ("--blocks", "2", "--iterations", "20"), lambda name: ply_path(tmp_path / name, 20)
    with monkeypatch.context() as patch:
        interrupt(patch, 10)
        assert train(tmp_path, *all_of_it) == 130
    assert "goes on with block 2/2" in capsys.readouterr().out
    others = {"--blocks 3": "block 1/3", "-w": "white_background True", "-r 2": "resolution 2"}
    for other, found in (others | {"--antialiasing": "antialiasing True"}).items():
        words = ("train", "-s", SCENE, "-m", tmp_path, *SHORT, *all_of_it, *other.split())
        assert f"1: expected a block of --{found}" in fails(*words)
    options = tmp_path / "1" / "cfg_args"
    options.write_text(options.read_text().replace(f"source_path='{SCENE}'", f"source_path='{tmp_path}'"))
    assert "1: expected a block of --source_path" in fails("train", "-s", SCENE, "-m", tmp_path, *SHORT, *all_of_it)
    options.write_text(options.read_text().replace(f"source_path='{tmp_path}'", "source_path='/on/another/machine'"))
    assert train(tmp_path, *all_of_it) == 0
    assert train(tmp_path / "alone", "--block", "2/2", *all_of_it[2:]) == 0
    settled = ("--settle_from_iter", "1", "--cooldown", "19", "--start_ply", str(tmp_path))
    assert train(tmp_path / "after", *settled) == 0
    for one, other in (("2", "alone"), ("together", "after")):
        assert place(one).read_bytes() == place(other).read_bytes()
    after, before = (load_gaussians(path).splats.means for path in (place("together"), ply_path(tmp_path, 60)))
    assert len(after) == len(before)  # nothing grows
    first = load_gaussians(ply_path(tmp_path / "1", 60))
    moved = first.splats._replace(means=0.99 * first.splats.means)
    save_gaussians(ply_path(tmp_path / "1", 60), first._replace(splats=moved))
    shutil.rmtree(tmp_path / "alone")
    again = "train", "-s", SCENE, "-m", tmp_path, *SHORT, *all_of_it
    assert "together: expected a training of these blocks as they are now" in fails(*again)
    assert (tmp_path / "together").rename(tmp_path.parent / "before") and train(tmp_path, *all_of_it) == 0
    assert place("together").read_bytes() != place("after").read_bytes()


def test_what_a_block_cannot_have(trained, tmp_path, fails, monkeypatch):
    block = ("train", "-s", SCENE, "-m", tmp_path / "a", "--block", "1/2", "--parts")
    assert "expected no part that learns" in fails(*block, "exposure")
    assert "expected parts by name" in fails(*block, "auto")
    for name, value in (("--block", "1/2"), ("--minutes", "1"), ("--resume", trained)):
        more = () if name == "--resume" else ("-s", SCENE)
        assert f"--blocks: expected no {name} beside it" in fails("train", *more, "--blocks", "2", name, value)
    assert "it already holds another model" in fails("train", "-s", SCENE, "--blocks", "2", "-m", trained)
    assert "expected another folder than the scene's" in fails("train", "-s", SCENE, "--blocks", "2", "-m", SCENE)
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert "--blocks: expected one process" in fails("train", "-s", SCENE, "--blocks", "2")
    monkeypatch.delenv("WORLD_SIZE")
    assert "--block 2/2: expected 1/2" in fails("train", "--resume", trained, "--block", "2/2")
