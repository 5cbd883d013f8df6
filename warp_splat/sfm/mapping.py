"""Cameras and points of photographs that are matched: by global mapping, by incremental where that is better.

Models that share photographs become one, and photographs that are left are added to it. Each step has its folder, which
gets its name when it is complete, so a run that was stopped goes on at the step. Each takes one thread: with two, a run
ends in other bytes, and no sooner.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from warp_splat.config import SfmConfig
from warp_splat.scene.colmap_library import pycolmap
from warp_splat.sfm.matching import fitting
from warp_splat.sfm.stages import run_watched

# Global mapping alone is enough if it registers this share of more photographs than that: incremental mapping takes
# longer the more there are, and could add little.
ENOUGH, MANY = 0.98, 100
FITS = 4.0  # px, what a match may miss by, as when pairs were verified
TORN = 1e-3  # share of sure pairs that need not fit. Of five sound models: 2e-4 at most, of one that is not: 4e-3
LINK = 30  # points that two photographs of one model share at least, one by one
SURE = 50  # features of a pair that are no chance: of 6,419 wrong pairs among 60 rooms alike, none had as many
SHARED = 3  # photographs that two models need to have in common to become one
RELAXED = {"abs_pose_min_num_inliers": 15, "abs_pose_min_inlier_ratio": 0.1, "abs_pose_max_error": 16.0}  # 30, 0.25, 12
# Seconds of global mapping, divided by the cube root of how many photographs there are, for the time that the bar says
# is left. Of seven captures of 25 to 3,000: 1.1e-5 to 2.9e-5 (Intel Xeon).
SECONDS_PER_MATCH = 2e-5


def reconstruct(
    database: Path, root: Path, models: Path, config: SfmConfig, say: Callable[[str], object]
) -> dict[int, pycolmap.Reconstruction]:
    """The models in the folder ``models`` by their names, "0" the one to take; none if no two photographs fit."""
    if not models.is_dir():
        images, matches = _sizes(database)
        begun = models.with_name("mapping")
        seconds = round(SECONDS_PER_MATCH * matches * images ** (1 / 3)) + 1
        mappers = {"global": partial(_map_globally, seconds=seconds), "incremental": _map_stepwise}
        found, fits = {}, {}
        for name, mapper in mappers.items():
            found[name] = _made(begun / name, partial(mapper, database, root, config))
            if found[name]:
                fits[name] = matches_that_fit(found[name][0], database)
                if images > MANY and _is_enough(found[name][0], *fits[name], images):
                    break
        # the most photographs; of as many, the most matches that fit
        best = max(fits, key=lambda name: (found[name][0].num_reg_images(), fits[name][0].sum()), default="global")
        told = ", ".join(f"{name} {_told(found[name][0], *fits[name]) if name in fits else 'none'}" for name in found)
        say(f"cameras by {best} mapping; photographs of {images}: {told}")
        every = found[best] + [model for name, each in found.items() if name != best for model in each]
        _made(models, partial(_finish, database, root, config, every))
        shutil.rmtree(begun)
    return {int(folder.name): pycolmap.Reconstruction(str(folder)) for folder in models.iterdir()}


def matches_that_fit(model: pycolmap.Reconstruction, database: Path) -> tuple[np.ndarray, np.ndarray]:
    """Of each pair of registered images, how many matches fit the model's cameras, and how many there are.

    A match fits if its two points lie within FITS of each other's epipolar lines (Sampson's error). A mapper leaves out
    points that do not fit its cameras, so the reprojection error of a wrong model may be the smaller one.
    """
    with pycolmap.Database.open(str(database)) as connection:
        images = {number: model.image(number) for number in model.reg_image_ids()}
        rays = {n: np.array(i.camera.cam_from_img(connection.read_keypoints(n)[:, :2])) for n, i in images.items()}
        found = [(0, 0)]
        for number, geometry in zip(*connection.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(number)
            if a in images and b in images:
                b_from_a = images[b].cam_from_world() * images[a].cam_from_world().inverse()
                essential = pycolmap.essential_matrix_from_pose(b_from_a)
                if essential.any():  # not from one and the same place, where there are no such lines
                    ends = zip((a, b), geometry.inlier_matches.T, strict=True)
                    errors = pycolmap.compute_squared_sampson_error(*(rays[n][rows] for n, rows in ends), essential)
                    close = np.sqrt(errors) < FITS / images[a].camera.mean_focal_length()
                    found.append((np.count_nonzero(close), len(errors)))
    return tuple(np.array(found).T)


def _is_enough(model: pycolmap.Reconstruction, fit: np.ndarray, every: np.ndarray, images: int) -> bool:
    """Whether incremental mapping could add little: photographs are there, and what surely fits does so here."""
    torn = (2 * fit < every)[every >= SURE]
    return model.num_reg_images() >= ENOUGH * images and bool(torn.sum() <= TORN * len(torn))


def _told(model: pycolmap.Reconstruction, fit: np.ndarray, every: np.ndarray) -> str:
    share, error = 100 * fit.sum() / max(every.sum(), 1), model.compute_mean_reprojection_error()
    return f"{model.num_reg_images()} ({share:.1f} % of {every.sum()} matches fit, {error:.2f} px)"


def _sizes(database: Path) -> tuple[int, int]:
    with pycolmap.Database.open(str(database)) as connection:
        return connection.num_images(), connection.num_inlier_matches()


def _made(folder: Path, make: Callable[[Path], object]) -> list[pycolmap.Reconstruction]:
    """The models in ``folder``, the best first; ``make`` has written them there, now or before."""
    if not folder.is_dir():
        part = folder.with_suffix(".part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        make(part)
        os.replace(part, folder)
    found = [pycolmap.Reconstruction(str(path)) for path in sorted(folder.iterdir())]
    return sorted(found, key=lambda model: model.num_reg_images(), reverse=True)


def _map_globally(database: Path, root: Path, config: SfmConfig, part: Path, seconds: int) -> None:
    """Global mapping (GLOMAP, Pan et al. 2024), with focal lengths from the view graph where no file says them."""
    with pycolmap.Database.open(str(database)) as connection:
        known = all(camera.has_prior_focal_length for camera in connection.read_all_cameras())
    options = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=config.seed)
    points = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=config.seed)

    def work() -> None:
        calibrated = Path(shutil.copyfile(database, part / database.name))  # it is written to
        leave_out_doubtful(calibrated)
        if not known:
            pycolmap.calibrate_view_graph(calibrated, pycolmap.ViewGraphCalibrationOptions(random_seed=config.seed))
        for number, model in pycolmap.global_mapping(calibrated, root, part, options).items():
            for each in set(model.reg_image_ids()) - held_together(model):
                model.deregister_frame(model.image(each).frame_id)
            # anew from these cameras: points that only two photographs see were left out, and training lacks them
            pycolmap.triangulate_points(model, calibrated, root, part / str(number), options=points)

    began = time.monotonic()
    run_watched(part, "cameras (s)", seconds, work, lambda: int(time.monotonic() - began), config.quiet, stops=False)
    (part / database.name).unlink()


def leave_out_doubtful(database: Path) -> None:
    """Delete pairs that may fit by chance: few features do, and both photographs surely fit to no third one.

    Rooms that look alike fit so, and global mapping would lay one on the other. A pair stays if no chain of sure ones
    joins its photographs, since then nothing else does.
    """
    matched = fitting(database)
    numbers, ends = np.unique(np.array(list(matched), int).reshape(-1, 2).T, return_inverse=True)
    sure = np.array(list(matched.values()), int) >= SURE
    fits = csr_array((np.ones(sure.sum(), int), ends[:, sure]), (len(numbers), len(numbers)))
    fits += fits.T
    _, parts = connected_components(fits)
    doubtful = ~sure & ((fits[ends[0]] * fits[ends[1]]).sum(axis=1) == 0) & (parts[ends[0]] == parts[ends[1]])
    with pycolmap.Database.open(str(database)) as connection:
        for pair in numbers[ends[:, doubtful]].T.tolist():
            connection.delete_two_view_geometry(*pair)


def held_together(model: pycolmap.Reconstruction) -> set[int]:
    """The largest set of images of which each shares LINK points or more with another.

    Global mapping puts parts of a capture into one model that hardly anything holds together, each at any place.
    """
    if not len(numbers := np.array(sorted(model.reg_image_ids()))):
        return set()
    seen = [np.unique([element.image_id for element in point.track.elements]) for point in model.points3D.values()]
    rows = np.searchsorted(numbers, np.concatenate(seen)) if seen else np.zeros(0, int)
    columns = np.repeat(np.arange(len(seen)), [len(each) for each in seen])
    sees = csr_array((np.ones(len(rows), np.int32), (rows, columns)), (len(numbers), len(seen)))
    _, labels = connected_components((sees @ sees.T) >= LINK)
    return set(numbers[labels == np.bincount(labels).argmax()].tolist())


def _map_stepwise(database: Path, root: Path, config: SfmConfig, part: Path, start: Path | None = None) -> None:
    """Incremental mapping; from the model ``start`` on, with thresholds that are relaxed, if there is one."""
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=config.seed)
    options.mapper.random_seed = options.triangulation.random_seed = config.seed
    if start:
        options.multiple_models = False
        options.fix_existing_frames = True  # they are adjusted; again, thousands take longer than all before
        options.mapper.mergedict(RELAXED)
    registered = [1] * (pycolmap.Reconstruction(str(start)).num_reg_images() if start else 0)
    found = {
        "initial_image_pair_callback": lambda: registered.extend((1, 1)),
        "next_image_callback": lambda: registered.append(1),
    }
    work = partial(pycolmap.incremental_mapping, database, root, part, options, input_path=start or "", **found)
    run_watched(part, "cameras", _sizes(database)[0], work, lambda: len(registered), config.quiet)


def _finish(database: Path, root: Path, config: SfmConfig, models: list[pycolmap.Reconstruction], part: Path) -> None:
    """Write the first of ``models``, joined with others and completed, and those that show other photographs."""
    if not models:
        return
    pycolmap.set_random_seed(config.seed)  # as where no run was stopped before
    model, others = joined(models, database, root, part)
    (part / "0").mkdir()
    model.write(str(part / "0"))
    if 0 < model.num_reg_images() < _sizes(database)[0]:
        (part / "more").mkdir()
        _map_stepwise(database, root, config, part / "more", part / "0")
        if (part / "more" / "images.bin").is_file():  # where it begins with a model, it writes one there
            more = pycolmap.Reconstruction(str(part / "more"))
            model = more if more.num_reg_images() > model.num_reg_images() else model
            model.write(str(part / "0"))
        shutil.rmtree(part / "more")
    seen = set(model.reg_image_ids())
    for other in others:
        if seen.isdisjoint(other.reg_image_ids()):  # both mappers may have found it
            seen.update(other.reg_image_ids())
            (place := part / str(len(os.listdir(part)))).mkdir()  # after "0" and those before it
            other.write(str(place))


def joined(
    models: list[pycolmap.Reconstruction], database: Path, root: Path, part: Path
) -> tuple[pycolmap.Reconstruction, list[pycolmap.Reconstruction]]:
    """The first of ``models`` with the cameras of all that share photographs with it, and the models that do not.

    Points are triangulated anew from all matches, and then all is adjusted. ``part`` is a folder to work in.
    """
    model, others = models[0], models[1:]
    while True:
        for other in others:
            mine, theirs = set(model.reg_image_ids()), set(other.reg_image_ids())
            if theirs <= mine or len(theirs & mine) < SHARED:
                continue
            if (model_from_other := pycolmap.align_reconstructions_via_reprojections(other, model)) is None:
                continue
            other.transform(model_from_other)
            model = _with_cameras(model, other, database)
            paths = map(str, (database, root, part / "triangulated"))
            model = pycolmap.triangulate_points(model, *paths, options={"num_threads": 1})
            pycolmap.bundle_adjustment(model, {"ceres": {"solver_options": {"num_threads": 1}}})
            shutil.rmtree(part / "triangulated")
            break
        else:
            return model, others


def _with_cameras(
    model: pycolmap.Reconstruction, other: pycolmap.Reconstruction, database: Path
) -> pycolmap.Reconstruction:
    """The cameras of ``model``, and those of ``other`` that it lacks; no points."""
    both = pycolmap.Reconstruction()
    with pycolmap.Database.open(str(database)) as connection:
        both.load(pycolmap.DatabaseCache.create(connection, pycolmap.DatabaseCacheOptions()))
    for each in (other, model):  # whose lenses are to stay
        for number, camera in each.cameras.items():
            both.camera(number).params = camera.params
        for number in each.reg_frame_ids():
            both.frame(number).rig_from_world = each.frame(number).rig_from_world
            both.register_frame(number)
    return both
