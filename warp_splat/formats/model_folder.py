"""The folder that a training leaves behind, laid out as the reference's, so that its viewers and scripts find things.

``cfg_args``, ``cameras.json``, ``input.ply``, ``point_cloud/iteration_N/point_cloud.ply``.
"""

import ast
import json
import os
import tempfile
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_splat.camera import Camera
from warp_splat.config import PROJECTIONS
from warp_splat.errors import InputError, refusing
from warp_splat.formats.exchange import FORMATS, load_gaussians
from warp_splat.formats.files import T, Unexpected, read_optional_json, write_text
from warp_splat.formats.splats import SplatFile, cropped
from warp_splat.lenses import Lens
from warp_splat.lenses.shutter import Shutter
from warp_splat.text import Report

if TYPE_CHECKING:
    from warp_splat.scene.types import View

CAMERAS = "cameras.json"
ENVIRONMENT = "environment.json"
AS_SAVED = "point_cloud/iteration_*/point_cloud.ply"


def default_model_path() -> Path:
    """A folder name that is new each time: ``output/`` and ten characters of a UUID."""
    return Path("output") / str(uuid.uuid4())[:10]


def check_place(folder: Path) -> None:
    """Refuse a folder that :func:`prepare_folder` could not create or write, as far as one sees without trying.

    Raises:
        InputError: if a file is in the way, or permissions are.
    """
    place = next(path for path in (folder.absolute(), *folder.absolute().parents) if os.path.lexists(path))
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        reason = "may not be written" if place.is_dir() else "is no folder"
        raise InputError(f"{folder}: expected a folder that can be written ({place} {reason}); choose another.")


def check_output(path: Path, model: str | Path = "", iteration: int = -1, endings: Sequence[str] = ()) -> None:
    """Refuse a file that could not be written, as far as one sees without trying: before the work.

    Raises:
        InputError: if it has none of these ``endings``, if there are any; if a folder has its name, or the Gaussians of
            ``model`` are read from it; or as :func:`check_place` of its folder.
    """
    if endings and path.suffix.lower() not in endings:
        wanted = f"expected a name that ends in {', '.join(endings)}"
        raise InputError(f"{path}: {wanted}, found {path.suffix or 'no ending'!r}; rename it.")
    if model and path.exists():
        file = gaussians_file(model, -1 if is_file_of_gaussians(model) else find_iteration(model, iteration))
        if file.exists() and path.samefile(file):
            raise InputError(f"{path}: expected another file than the model; name a new one.")
    if path.is_dir():
        raise InputError(f"{path}: expected the name of a file to write, found a folder; name a file in it.")
    check_place(path.parent)


def prepare_folder(folder: str | Path) -> Path:
    """Create the model folder and prove that it can be written, before hours of training.

    Raises:
        InputError: if the folder cannot be created or written.
    """
    folder = Path(folder)
    with refusing(OSError, f"{folder}: expected a folder that can be written", "; choose another."):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"written and removed at the start of a training")
    return folder


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """:func:`prepare_folder` it, and keep other trainings, or reconstructions, out while the block runs.

    Raises:
        InputError: if the folder cannot be written, or another process holds it.
    """
    from filelock import FileLock, Timeout  # noqa: PLC0415 - only these need it

    lock = FileLock(prepare_folder(folder) / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise InputError(f"{folder}: another run writes here; wait for it, or choose another folder.") from error
    except OSError as error:
        raise InputError(
            f"{lock.lock_file}: expected a file to write, which tells other runs that this one is at work, found "
            f"{error.strerror or error}; remove it if none is at work there, or choose another folder."
        ) from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes it on release
            Path(lock.lock_file).unlink()
        lock.release()


def ply_path(folder: str | Path, iteration: int) -> Path:
    """Where the Gaussians of an iteration are."""
    return Path(folder) / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"


def find_iteration(folder: str | Path, iteration: int = -1) -> int:
    """The iteration to load: the one asked for, or the largest saved one for -1.

    Raises:
        InputError: if there is no such iteration.
    """
    if not Path(folder).is_dir():
        raise InputError(f"{folder}: expected the folder of a trained model, found no such folder; check the path.")
    names = (path.name.removeprefix("iteration_") for path in (Path(folder) / "point_cloud").glob("iteration_*"))
    saved = sorted({int(name) for name in names if name.isdecimal() and ply_path(folder, int(name)).is_file()})
    if not saved:
        raise InputError(f"{folder}: expected point_cloud/iteration_*/*.ply, found none; is it a model folder?")
    if iteration == -1:
        return saved[-1]
    if iteration not in saved:
        raise InputError(f"{folder}: iteration {iteration} was not saved; those saved: {', '.join(map(str, saved))}.")
    return iteration


def is_file_of_gaussians(path: str | Path) -> bool:
    """Whether this names a file, of Gaussians it is to be hoped, not the folder of a model."""
    path = Path(path)
    return path.is_file() or (not path.exists() and path.suffix.lower() in FORMATS)


def gaussians_file(path: str | Path, iteration: int) -> Path:
    """Where the Gaussians of a model folder are, or this file."""
    return Path(path) if is_file_of_gaussians(path) else ply_path(path, iteration)


def folder_of(path: str | Path) -> Path:
    """The model folder in which a file lies where training puts it; else the path itself."""
    place = Path(os.path.abspath(path))
    return place.parents[2] if place.match(AS_SAVED) else Path(path)


def open_model(
    path: str | Path, iteration: int = -1, crop: Sequence[float] = (), report: Report = print
) -> tuple[int, SplatFile, dict]:
    """The iteration, the Gaussians and the options of the training, from a model folder or a file of Gaussians.

    Of a file, the iteration is 0. Where there is no cfg_args, the options are that every 8th view was held out, and
    what the file tells; a file where training puts it has those of its folder. ``crop`` as
    :func:`warp_splat.formats.splats.cropped` takes it, ``report`` as
    :func:`warp_splat.formats.exchange.load_gaussians`.

    Raises:
        InputError: if there is no such model (a file has no iterations), it cannot be read, or was trained with an
            unknown projection.
    """
    if (is_file := is_file_of_gaussians(path)) and iteration != -1:
        raise InputError(f"{path}: expected a model folder for iteration {iteration}, found a file; leave that out.")
    iteration = 0 if is_file else find_iteration(path, iteration)
    found = load_gaussians(gaussians_file(path, iteration), report)
    args = folder_of(path) / "cfg_args"
    options = read_cfg_args(args.parent) if args.exists() else {"eval": True}
    if (projection := options.get("projection", PROJECTIONS[0])) not in PROJECTIONS:
        raise InputError(f"{args}: expected a projection of {', '.join(PROJECTIONS)}, found {projection!r:.40}.")
    options = {"antialiasing": found.antialiased, "linear_light": found.linear or None, **options}
    marks = {"antialiased": bool(options["antialiasing"]), "linear": bool(options["linear_light"])}
    return iteration, found._replace(splats=cropped(found.splats, crop), **marks), options


def write_cfg_args(folder: str | Path, namespace: Mapping[str, object]) -> None:
    """Write the arguments of a training as the reference does: one line ``Namespace(name=value, ...)``.

    Args:
        folder: the model folder.
        namespace: argument names and values: Python literals, or paths, which are written as strings.

    Raises:
        InputError: if a value is not a literal (such a line could not be read back), or the file cannot be written.
    """
    path = Path(folder) / "cfg_args"
    values = {name: str(value) if isinstance(value, Path) else value for name, value in namespace.items()}
    line = f"Namespace({', '.join(f'{name}={value!r}' for name, value in values.items())})"
    _parse_namespace(line, path)
    write_text(path, line)


def read_cfg_args(folder: str | Path) -> dict[str, object]:
    """Read ``cfg_args``. The values are parsed as literals and never evaluated, whoever wrote the file.

    Raises:
        InputError: if the file is missing or holds anything but ``Namespace(name=literal, ...)``.
    """
    path = Path(folder) / "cfg_args"
    with refusing((OSError, UnicodeDecodeError), f"{path}: could not be read", f"; is {folder} a model folder?"):
        text = path.read_text(encoding="utf-8")
    return _parse_namespace(text, path)


def _parse_namespace(text: str, path: Path) -> dict[str, object]:
    kinds = (SyntaxError, ValueError, TypeError, RecursionError, MemoryError)
    with refusing(kinds, f"{path}: expected one line Namespace(name=literal, ...), found another"):
        call = ast.parse(text.strip(), mode="eval").body
        if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or call.func.id != "Namespace":
            raise ValueError("no Namespace(...)")
        if call.args or any(keyword.arg is None for keyword in call.keywords):
            raise ValueError("an argument without a name")
        return {str(keyword.arg): ast.literal_eval(keyword.value) for keyword in call.keywords}


def write_cameras(
    folder: str | Path, views_test: "Sequence[View]", views_train: "Sequence[View]", coordinates: dict | None = None
) -> None:
    """Write ``cameras.json`` for viewers: test cameras first, then training cameras, at their original sizes.

    Positions are camera centers and rotations camera-to-world, both in the frame of the scene; focal lengths in pixels.
    Where the scene's ``coordinates`` are known, each camera has the "origin" of that frame in the world.

    Raises:
        InputError: if the file cannot be written.
    """
    origin = {"origin": coordinates["origin"]} if coordinates else {}
    cameras = [
        {"id": i, "img_name": view.name, **camera_entry(view.original), **origin, "trained": i >= len(views_test)}
        for i, view in enumerate([*views_test, *views_train])
    ]
    write_text(Path(folder) / CAMERAS, json.dumps(cameras, allow_nan=False))


def camera_entry(camera: Camera) -> dict[str, object]:
    """A camera as ``cameras.json`` has it; the reference's lacks principal point, lens and shutter."""
    pose = {"position": camera.center.tolist(), "rotation": camera.rotation.T.tolist()}
    focal = {name: getattr(camera, name) for name in ("fy", "fx", "cx", "cy")}
    extra = {name: asdict(part) for name in ("lens", "shutter") if (part := getattr(camera, name))}
    return {"width": camera.width, "height": camera.height, **pose, **focal, **extra}


def read_cameras(folder: str | Path) -> list[tuple[str, Camera]]:
    """The names and cameras of ``cameras.json``, none if there is no such file.

    Where the file has no principal point, as the reference's, it is the middle of the image.

    Raises:
        InputError: if the file is damaged.
    """

    def parse(entries: list[dict]) -> list[tuple[str, Camera]]:
        if not isinstance(entries, list):
            raise Unexpected("other JSON")
        try:
            return [(str(entry["img_name"]), _camera(entry)) for entry in entries]
        except InputError as error:
            raise Unexpected(f"a camera with other values ({error!s:.200})") from error

    return read_optional_json(Path(folder) / CAMERAS, "a list of cameras as training writes it", parse) or []


def trained_names(path: str | Path) -> set[str]:
    """The photographs that the model in a folder was trained on, if its ``cameras.json`` says so.

    Raises:
        InputError: if the file is damaged.
    """
    names = lambda entries: {str(entry["img_name"]) for entry in entries if entry.get("trained")}  # noqa: E731
    return read_optional_json(folder_of(path) / CAMERAS, "a list of cameras as training writes it", names) or set()


def read_refined(path: str | Path, iteration: int) -> dict[str, Camera]:
    """The cameras that were learned with the Gaussians of a model folder, or of a file in one, by name; mostly none.

    Raises:
        InputError: if the file is damaged.
    """
    file = gaussians_file(path, iteration)
    return dict(read_cameras(file.parent)) if folder_of(file) != file else {}


def write_environment(ply: Path, harmonics: np.ndarray | None) -> None:
    """Beside a model's Gaussians, write what lies behind them: coefficients as those of a Gaussian, [16, 3], or None.

    Raises:
        InputError: if the file cannot be written.
    """
    write_beside(ply, ENVIRONMENT, None if harmonics is None else {"harmonics": harmonics.tolist()})


def read_environment(path: str | Path, iteration: int) -> np.ndarray | None:
    """What lies behind the Gaussians of a model folder, or of a file in one, [16, 3] float32; None if nothing does.

    Raises:
        InputError: if the file is damaged.
    """

    def parse(facts: dict) -> np.ndarray:
        if (harmonics := np.array(facts["harmonics"], np.float32)).shape != (16, 3) or not np.isfinite(harmonics).all():
            raise Unexpected(f"shape {list(harmonics.shape)}, or numbers that are not finite, as by a large --sky_lr")
        return harmonics

    return read_beside(path, iteration, ENVIRONMENT, "harmonics as training writes them", parse)


def write_beside(ply: Path, name: str, facts: Mapping[str, object] | None) -> None:
    """Write JSON beside a model's Gaussians. None: there is none; what an earlier training wrote there is removed.

    Raises:
        InputError: if the file cannot be written.
    """
    if facts is None:
        (ply.parent / name).unlink(missing_ok=True)
    else:
        write_text(ply.parent / name, json.dumps(facts))  # what reads it refuses numbers that are not finite


def read_beside(path: str | Path, iteration: int, name: str, expected: str, parse: Callable[[Any], T]) -> T | None:
    """What ``parse`` makes of the JSON beside the Gaussians of a model folder, or beside a file; None if there is none.

    Raises:
        InputError: if the file is damaged, or another than ``expected``.
    """
    return read_optional_json(gaussians_file(path, iteration).parent / name, expected, parse)


def _camera(entry: dict) -> Camera:
    rotation = np.array(entry["rotation"], np.float64).T
    position = np.array(entry["position"], np.float64)
    middle = {"cx": 0.5 * entry["width"], "cy": 0.5 * entry["height"]}
    numbers = {name: entry.get(name, middle.get(name)) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    lens = Lens(entry["lens"]["model"], tuple(entry["lens"]["coefficients"])) if entry.get("lens") else None
    shutter = Shutter(entry["shutter"]["turn"], entry["shutter"]["shift"]) if entry.get("shutter") else None
    return Camera(**numbers, rotation=rotation, translation=-rotation @ position, lens=lens, shutter=shutter)
