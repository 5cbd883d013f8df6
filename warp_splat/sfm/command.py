"""``warp-splat sfm``: photographs or a video in, a scene to train on out, and what came of it."""

import json
import os
import shlex
import shutil
import time
import zlib
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from warp_splat.config import CORES, SfmConfig
from warp_splat.errors import InputError, refusing
from warp_splat.formats.coordinates import write_coordinates
from warp_splat.formats.files import write_json, write_text
from warp_splat.formats.model_folder import claimed
from warp_splat.runtime.devices import peak_memory
from warp_splat.scene import has_cameras, images
from warp_splat.scene.colmap_library import pycolmap, require_pycolmap
from warp_splat.scene.photos import PHOTOS, VIDEOS, find_files, is_video, jpeg_hint, photo_root, scene_of, sfm_hint
from warp_splat.sfm import mapping, stages
from warp_splat.sfm.georeference import georeference, read_places, require_named, scale_as_usual
from warp_splat.sfm.matching import match
from warp_splat.text import few

WORK = "sfm"  # the folder of the work inside the scene: what resuming needs
MARKS, PIECE = "marks.json", 2**16  # numbers of so many bytes from the middle of each photograph
LEAST = 3  # registered photographs; a scene of fewer shows nothing from another side
FEW = 0.6  # share of registered photographs below which the user is told what to do
ADVICE = (
    "photographs should overlap by two thirds, show texture, be sharp, and be taken from different places, not by "
    "turning on the spot"
)


def sfm(config: SfmConfig) -> int:
    """Compute cameras as ``config`` says; returns the process's exit code.

    Raises:
        InputError: if the photographs or the folder cannot be used, or too few photographs fit together.
    """
    started = time.perf_counter()
    source, scene = Path(config.photos), Path(config.scene)
    say = (lambda *_: None) if config.quiet else tqdm.write
    require_pycolmap("warp-splat sfm")
    if not (source.is_dir() or is_video(source)):
        found = f"a file ending in {source.suffix!r}" if source.is_file() else "nothing"
        raise InputError(
            f"{source}: expected a folder of photographs or a video ({', '.join(VIDEOS)}), found {found}; name one."
        )
    if config.coordinates not in ("auto", "none"):
        read_places(Path(config.coordinates))  # hours before it is needed
        config = replace(config, coordinates=os.path.abspath(config.coordinates))
    work = _claim(source, scene, config)
    summary = work / "summary.json"
    told = json.loads(summary.read_text()) if summary.is_file() else {}  # else a run was stopped right before
    config = replace(config, threads=min(config.threads or CORES, CORES))
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # its progress is ours to tell
    pycolmap.set_random_seed(config.seed)
    if (scene / "sparse").is_dir():
        if config.coordinates not in ("auto", before := told.get("coordinates", config.coordinates)):
            raise InputError(f"--coordinates {config.coordinates}: {scene} has those of {before}; remove its sparse/.")
        say(f"{scene} is complete already; remove it to start anew.")
    else:
        with claimed(work), _explained(work):
            root = _frames(source, work, config, say) if is_video(source) else photo_root(source)
            names = find_files(root, PHOTOS, None if is_video(source) else scene)
            told = _reconstruct(root, names, scene, work, config, say)
        told["seconds_of_last_run"] = round(time.perf_counter() - started, 1)
        write_json(summary, told)
    if told:
        _summarize(scene, told)
    return 0


def scene_for(photos: str, processes: int, **options: Any) -> str:
    """The scene to train on: ``photos`` if it has cameras; otherwise one beside it, made or completed now.

    Raises:
        InputError: as :func:`sfm`; if there are several processes, which would all do the same.
    """
    if not photos or has_cameras(Path(photos)):
        return photos
    if processes > 1:
        raise InputError(f"--sfm: expected one process, found {processes}; {sfm_hint(Path(photos))}")
    scene = str(scene_of(Path(photos)))
    sfm(SfmConfig(photos, scene, **options))
    return scene


@contextmanager
def _explained(work: Path) -> Iterator[None]:
    """Turn what pycolmap raises, of a full disk or a damaged database, into a sentence; what was not begun goes."""
    advice = "; free some space if the disk is full and run again, or remove this folder to start anew."
    with refusing((RuntimeError, ValueError, IndexError), f"{work}: pycolmap cannot go on there", advice):
        try:
            yield
        except InputError:
            if not (work / "database.db").exists() and not (work / "frames").exists():
                shutil.rmtree(work, ignore_errors=True)
                with suppress(OSError):  # there is something else in it
                    work.parent.rmdir()
            raise


def _claim(source: Path, scene: Path, config: SfmConfig) -> Path:
    """The folder of the work in ``scene``, which is new, or was begun on the same input with the same options."""
    work, options = scene / WORK, {name: getattr(config, name) for name in ("frames", "matching", "seed")}
    options |= {"keep_lens": True} if config.keep_lens else {}
    if os.path.realpath(source) == os.path.realpath(scene):
        raise InputError(f"{scene}: expected another folder than that of the photographs for the scene; choose one.")
    if source.is_dir():
        root = photo_root(source)
        if Path(os.path.realpath(scene)) in (root.resolve(), *root.resolve().parents):
            raise InputError(
                f"{scene}: expected a folder for the scene that does not hold the photographs, since its images/ would "
                f"be written over; choose another, such as {scene_of(scene)}."
            )
        if not (files := [(name, root / name) for name in find_files(root, PHOTOS, scene)]):
            hints = [f"name the video itself: {shlex.quote(str(root / name))}" for name in find_files(root, VIDEOS)]
            hint = jpeg_hint(source) or (hints or ["check the path"])[0]
            raise InputError(f"{source}: expected photographs ({', '.join(PHOTOS)}), found none; {hint}.")
    else:
        files = [(source.name, source)]
    record = json.dumps({"options": options, "files": {name: path.stat().st_size for name, path in files}}, indent=1)
    pieces = {name: np.fromfile(path, np.uint8, PIECE, offset=path.stat().st_size // 2) for name, path in files}
    marks = json.dumps({name: zlib.crc32(piece) for name, piece in pieces.items()}, indent=1)  # once, there was none
    if (work / "input.json").is_file():
        same = not (work / MARKS).is_file() or (work / MARKS).read_bytes() == marks.encode()
        if not same or (work / "input.json").read_bytes() != record.encode():
            raise InputError(
                f"{scene}: expected a folder begun with the same photographs and options, but this one was begun with "
                "others; choose another folder, or remove this one."
            )
    elif scene.exists() and (not scene.is_dir() or any(p not in (work, work / MARKS) for p in scene.rglob("[!.]*"))):
        raise InputError(f"{scene}: expected a new or empty folder, found one that is in use; choose another.")
    else:
        write_text(work / MARKS, marks)
        write_text(work / "input.json", record)
    return work


def _frames(video: Path, work: Path, config: SfmConfig, say) -> Path:
    """The folder of the frames taken from ``video``."""
    from warp_splat.sfm.video import sample_frames  # noqa: PLC0415 - only videos need PyAV

    frames, part = work / "frames", work / "frames.part"
    if not frames.is_dir():
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        with tqdm(total=100, desc="frames", unit="%", disable=config.quiet) as bar:
            count = sample_frames(video, part, config, say, lambda share: bar.update(share - bar.n))
            bar.update(100 - bar.n)
        if count < LEAST:
            raise InputError(f"{video}: expected a video of at least {LEAST} frames, {count} could be decoded.")
        os.replace(part, frames)
    say(f"{len(find_files(frames, PHOTOS))} sharp frames of {video.name} in {frames}")
    return frames


def _reconstruct(root: Path, names: list[str], scene: Path, work: Path, config: SfmConfig, say) -> dict[str, Any]:
    """All stages, the largest model as the scene; returns what there is to say of it."""
    groups, broken = _groups(root, names, config.threads, say)
    if len(names := [name for group in groups for name in group]) < LEAST:
        raise InputError(f"{root}: expected at least {LEAST} readable photographs, found {len(names)}; add some.")
    if config.coordinates not in ("auto", "none"):
        require_named(Path(config.coordinates), names)
    lenses = f"{len(groups)} lens{'es' * (len(groups) > 1)}"
    say(f"{len(names)} photographs, {lenses}, {config.threads} threads; work in {work}")
    database = work / "database.db"
    taken: dict[str, dict[str, float]] = {}
    with _taking("features", taken):
        stages.extract(database, root, groups, config)
    with _taking("matches", taken):
        pairs = match(database, config, say)
    with _taking("cameras", taken):
        models = mapping.reconstruct(database, root, work / "models", config, say)
    sizes = {index: model.num_reg_images() for index, model in models.items()}
    if sizes.get(0, 0) < LEAST:
        shutil.rmtree(work / "models")  # the next run may have another seed of luck, and more photographs
        raise InputError(
            f"{root}: {sizes.get(0, 0)} of {len(names)} photographs could be registered, expected at least {LEAST} "
            f"({pairs} pairs of them fit together); {ADVICE}."
        )
    model, path = models[0], work / "placed"
    registered = {model.image(index).name for index in model.reg_image_ids()}
    if not (where := georeference(model, database, config.coordinates, config.seed, say)):
        scale_as_usual(model)
    path.mkdir(exist_ok=True)
    model.write(str(path))
    write_coordinates(scene, where)
    with _taking("images", taken):
        stages.write_scene(path, root, scene, work / "scene.part", sizes[0], config)
    return {
        "photographs": len(names) + len(broken),
        "unreadable": broken,
        "registered": sizes[0],
        "unregistered": sorted(set(names) - registered),
        "registered_by_model": sorted(sizes.values(), reverse=True),
        "points": model.num_points3D(),
        "reprojection_error_px": model.compute_mean_reprojection_error(),
        "track_length": model.compute_mean_track_length(),
        "threads": config.threads,
        "keep_lens": config.keep_lens,
        "coordinates": config.coordinates if where else "none",
        "stages_of_last_run": taken,
    }


@contextmanager
def _taking(stage: str, taken: dict[str, dict[str, float]]) -> Iterator[None]:
    """Note the seconds of a stage, by the clock and of all threads, and the most memory of the process at its end."""
    began, worked = time.perf_counter(), time.process_time()
    yield
    seconds, of_threads = time.perf_counter() - began, time.process_time() - worked
    taken[stage] = {"seconds": seconds, "seconds_of_threads": of_threads, "peak_mib": peak_memory() or 0}


def _groups(root: Path, names: list[str], threads: int, say) -> tuple[list[list[str]], list[str]]:
    """Names of photographs by the lens that they share, and those that cannot be read, which are left out."""

    def lens(name: str) -> tuple | None:
        try:
            images.read_pixels(root / name, 0.0)  # to the end: of a file that is cut short, pycolmap takes a part
            return images.read_lens(root / name)
        except InputError as error:
            say(f"warning: leaving out a photograph: {error}")
            return None

    groups: dict[Any, list[str]] = defaultdict(list)
    with ThreadPoolExecutor(threads) as pool:
        for name, key in zip(names, pool.map(lens, names), strict=True):
            groups[key].append(name)
    broken = groups.pop(None, [])
    return list(groups.values()), broken


def _summarize(scene: Path, summary: dict[str, Any]) -> None:
    registered, count = summary["registered"], summary["photographs"]
    print(
        f"{scene}: {registered} of {count} photographs registered, {summary['points']} points, mean reprojection error "
        f"{summary['reprojection_error_px']:.2f} px, {summary['track_length']:.1f} photographs per point, "
        f"{summary['seconds_of_last_run'] / 60:.1f} min"
    )
    for what in ("unreadable", "unregistered"):
        if names := summary[what]:
            print(f"  {what}: {few(names)}")
    if others := summary["registered_by_model"][1:]:
        print(f"  the photographs fall apart into {len(others) + 1} models; others have {', '.join(map(str, others))}")
    if registered < FEW * count:
        print(f"  warning: only {registered} of {count} photographs registered; {ADVICE}.")
    lens = ["--lens", "native"] if summary.get("keep_lens") else []
    print(f"  train on it: {shlex.join(['warp-splat', 'train', '-s', str(scene), '--eval', *lens])}")
