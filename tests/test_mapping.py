"""Models of synthetic matches, whose cameras are known: which mapper wins, what is joined, what is added."""

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hostile import refusal
from scene_files import write_image

from warp_splat.config import SfmConfig
from warp_splat.formats.model_folder import claimed
from warp_splat.sfm import mapping
from warp_splat.sfm.command import sfm
from warp_splat.sfm.matching import fitting

COUNT = 20
CONFIG = SfmConfig("", "", threads=1, quiet=True)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """A database with matches of known cameras, and the model that has them."""
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_points3D=200)
    options.num_frames_per_rig = COUNT
    database = tmp_path_factory.mktemp("mapping") / "database.db"
    with pycolmap.Database.open(database) as connection:
        return database, pycolmap.synthesize_dataset(options, connection)


def part_of(model, folder: Path, numbers, moved=None):
    """The model of these of its images alone, in another frame."""
    some = pycolmap.Reconstruction(model)
    for index, number in enumerate(sorted(model.reg_image_ids())):
        if index not in numbers:
            some.deregister_frame(some.image(number).frame_id)
    some.transform(moved or pycolmap.Sim3d())
    folder.mkdir(parents=True)
    some.write(folder)
    return pycolmap.Reconstruction(folder)


def farthest(model, truth):
    """The largest error of a camera's center, in the truth's frame, as a share of its extent."""
    numbers = model.reg_image_ids()
    found, expected = (np.array([each.image(i).projection_center() for i in numbers]) for each in (model, truth))
    errors = np.linalg.norm(pycolmap.estimate_sim3d(found, expected) * found - expected, axis=1)
    return errors.max() / np.ptp(expected, axis=0).max()


def test_models_that_share_photographs_are_joined(truth, tmp_path):
    database, model = truth
    moved = pycolmap.Sim3d(2.0, pycolmap.Rotation3d(np.array([0.1, 0.5, 0.2])), np.array([1.0, 2, 3]))
    parts = [range(8), range(5, 14), range(14, COUNT)]
    models = [part_of(model, tmp_path / str(k), part, moved if k else None) for k, part in enumerate(parts)]
    found, others = mapping.joined(models, database, tmp_path, tmp_path)
    assert found.num_reg_images() == 14 and farthest(found, model) < 1e-4
    assert found.compute_mean_reprojection_error() < 0.01
    seen = set(found.reg_image_ids())
    assert [other.num_reg_images() for other in others if not seen.intersection(other.reg_image_ids())] == [6]


def test_a_folder_where_another_run_works_is_refused(tmp_path):
    write_image(tmp_path / "photos" / "0.png", np.zeros((8, 8, 3), np.uint8))
    with claimed(tmp_path / "scene" / "sfm"):
        refusal(lambda: sfm(SfmConfig(str(tmp_path / "photos"), str(tmp_path / "scene"))), "another run writes here")


@pytest.fixture
def mapped(truth, tmp_path):
    """Maps the database as photographs are; the models, and what is told."""

    def run():
        lines: list[str] = []
        shutil.copy(truth[0], tmp_path)
        models = mapping.reconstruct(tmp_path / "database.db", tmp_path, tmp_path / "models", CONFIG, lines.append)
        return models, lines

    return run


def unwanted(*_, **__):
    pytest.fail("this mapping was begun")


def torn(model, shift):
    """All photographs of ``model``, the second half of them moved aside."""
    moved = pycolmap.Reconstruction(model)
    for number in sorted(moved.reg_frame_ids())[COUNT // 2 :]:
        pose = moved.frame(number).rig_from_world
        aside = pose.translation + pose.rotation * np.array(shift)
        moved.frame(number).rig_from_world = pycolmap.Rigid3d(pose.rotation, aside)
    return moved


def test_matches_tell_a_model_that_is_torn(truth):
    """Of all pairs that see each other, those on one side of the tear fit, the others do not."""
    database, model = truth
    fit, every = mapping.matches_that_fit(model, database)
    assert every.sum() == sum(fitting(database).values()) and (fit == every).all()
    fit, every = mapping.matches_that_fit(torn(model, (1.0, 2.0, 0.0)), database)
    half = COUNT // 2
    assert np.count_nonzero(fit == every) - 1 == half * (half - 1)
    assert 10 * np.count_nonzero(2 * fit < every) > 9 * half**2


def test_what_hardly_anything_holds_together_is_no_part_of_a_model(truth):
    """Points that the last 8 photographs share with others are left out, but for 5."""
    some = pycolmap.Reconstruction(truth[1])
    apart = set(sorted(some.reg_image_ids())[-8:])
    for index, number in enumerate(sorted(some.point3D_ids())):
        for image, place in [(each.image_id, each.point2D_idx) for each in some.point3D(number).track.elements]:
            if index > 5 and (image in apart) == (index % 3 > 0):
                some.delete_observation(image, place)
    assert mapping.held_together(truth[1]) == set(truth[1].reg_image_ids())
    assert mapping.held_together(some) == set(some.reg_image_ids()) - apart


def test_pairs_that_may_fit_by_chance_are_left_out(tmp_path):
    """A walk 0 to 5 whose neighbors surely fit: (0, 2) shares 1 with them, (0, 5) nothing; only (0, 6) knows 6."""
    sure, doubtful = [(k, k + 1) for k in range(5)], [(0, 2), (0, 5), (0, 6)]
    with pycolmap.Database.open(tmp_path / "database.db") as connection:
        camera = connection.write_camera(pycolmap.Camera.create_from_model_name(0, "PINHOLE", 100, 100, 100))
        images = [connection.write_image(pycolmap.Image(f"{k}.jpg", camera_id=camera)) for k in range(7)]
        for pair in (*sure, *doubtful):
            count = mapping.SURE - (pair in doubtful)
            matches = np.repeat(np.arange(count)[:, None], 2, axis=1)
            geometry = pycolmap.TwoViewGeometry(config=2, inlier_matches=matches)
            connection.write_two_view_geometry(images[pair[0]], images[pair[1]], geometry)
    mapping.leave_out_doubtful(tmp_path / "database.db")
    left = {(images.index(a), images.index(b)) for a, b in fitting(tmp_path / "database.db")}
    assert left == {*sure, (0, 2), (0, 6)}


def test_the_better_mapper_is_taken_and_completed(truth, mapped, monkeypatch):
    """Global finds 12, incremental 9 of other photographs: they are joined, and the rest is added."""
    _, model = truth

    def found(numbers):
        return lambda database, root, config, part, **_: part_of(model, part / "0", numbers)

    stepwise = mapping._map_stepwise
    monkeypatch.setattr(mapping, "_map_globally", found(range(12)))
    either = lambda *a, **k: (stepwise if len(a) > 4 else found(range(8, 17)))(*a, **k)  # noqa: E731
    monkeypatch.setattr(mapping, "_map_stepwise", either)
    models, lines = mapped()
    assert list(models) == [0] and models[0].num_reg_images() == COUNT and farthest(models[0], model) < 1e-4
    assert len(lines) == 1 and "global mapping" in lines[0] and "global 12" in lines[0] and "incremental 9" in lines[0]


def test_what_both_mappers_found_apart_is_written_once(truth, mapped, monkeypatch):
    """Two groups that share nothing, each a model of either mapper."""

    def found(database, root, config, part, *start, **_):
        for number, group in enumerate((range(12), range(12, COUNT))):
            if not start:
                part_of(truth[1], part / str(number), group)

    monkeypatch.setattr(mapping, "_map_globally", found)
    monkeypatch.setattr(mapping, "_map_stepwise", found)
    models, _ = mapped()
    assert [models[number].num_reg_images() for number in sorted(models)] == [12, COUNT - 12]


def test_incremental_mapping_is_spared_where_it_could_add_little(truth, mapped, tmp_path, monkeypatch):
    copies: list[Path] = []
    for name, value in (("MANY", COUNT - 1), ("_map_stepwise", unwanted), ("leave_out_doubtful", copies.append)):
        monkeypatch.setattr(mapping, name, value)
    models, lines = mapped()
    assert models[0].num_reg_images() == COUNT and farthest(models[0], truth[1]) < 1e-3
    assert "incremental" not in lines[0]
    assert len(copies) == 1 and copies[0].parent != tmp_path and not copies[0].exists()


def test_of_as_many_photographs_the_model_that_fits_the_matches_is_taken(truth, mapped, monkeypatch):
    """Global mapping registers all and tears the model, so incremental mapping is begun, which is right."""
    _, model = truth

    def found(model):
        return lambda database, root, config, part, **_: part_of(model, part / "0", range(COUNT))

    monkeypatch.setattr(mapping, "MANY", COUNT - 1)
    monkeypatch.setattr(mapping, "_map_globally", found(torn(model, (1.0, 2.0, 0.0))))
    monkeypatch.setattr(mapping, "_map_stepwise", found(model))
    models, lines = mapped()
    assert farthest(models[0], model) < 1e-6 and "cameras by incremental mapping" in lines[0]


def test_a_mapper_that_was_complete_is_not_begun_again(truth, mapped, tmp_path, monkeypatch):
    (tmp_path / "models.part").mkdir()  # it was killed then
    for name, begin in (("global", "_map_globally"), ("incremental", "_map_stepwise")):
        part_of(truth[1], tmp_path / "mapping" / name / "0", range(COUNT))
        monkeypatch.setattr(mapping, begin, unwanted)
    models, _ = mapped()
    assert models[0].num_reg_images() == COUNT
    assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db", "models"]
