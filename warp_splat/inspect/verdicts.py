"""Checks that need no pixels: cameras, names, masks, what the loader and the training will say."""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from warp_splat.errors import InputError
from warp_splat.formats.coordinates import read_coordinates
from warp_splat.inspect.subject import Finding, Subject
from warp_splat.scene import MASKS, read_photos, require_one_kind, require_unmasked, require_visible, too_far, too_near
from warp_splat.scene.photos import READABLE, find_files
from warp_splat.text import few

FIELDS_OF_VIEW = 15.0, 120.0  # degrees; lenses outside of it are rare, and wrong focal lengths land there
ASPECT = 1.2  # fx / fy of a real camera is nearly 1
OFF_CENTER = 0.1  # of the image's width or height
AT_LEAST = 20  # images; fewer train, but show little from new sides


def check_cameras(subject: Subject) -> Iterator[Finding]:
    """Lenses, how many, and whether their numbers are those of a real camera."""
    lenses = Counter(f"PINHOLE {photo.camera.width} x {photo.camera.height}" for photo in subject.photos)
    if subject.model is not None:
        cameras = [subject.model.image(i).camera for i in subject.model.reg_image_ids()]
        lenses = Counter(f"{lens.model_name} {lens.width} x {lens.height}" for lens in cameras)
    text = few(f"{name} px in {count} images" for name, count in lenses.most_common()) or "none"
    distorted = sum(photo.sampling is not None for photo in subject.photos)
    text += f"; {distorted} images are undistorted on loading" * (distorted > 0)
    yield Finding("cameras", "ok" if lenses else "error", f"{text}.")
    odd: dict[str, list[str]] = defaultdict(list)
    for photo in subject.photos:
        camera = photo.camera
        angle = 2 * np.degrees(np.arctan(0.5 * camera.width / camera.fx))
        if not FIELDS_OF_VIEW[0] <= angle <= FIELDS_OF_VIEW[1]:
            odd[f"a field of view of {angle:.0f} degrees"].append(photo.name)
        if not 1 / ASPECT <= camera.fx / camera.fy <= ASPECT:
            odd[f"fx / fy = {camera.fx / camera.fy:.2f}"].append(photo.name)
        off = abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5)
        if max(off) > OFF_CENTER:
            odd[f"a principal point {100 * max(off):.0f} % of the image beside its middle"].append(photo.name)
    for what, names in odd.items():
        yield Finding("intrinsics", "warning", f"{what} is unusual: {few(names)}.")
    if not odd and subject.photos:
        focal = sorted(photo.camera.fx / photo.camera.width for photo in subject.photos)
        yield Finding("intrinsics", "ok", f"focal lengths are {focal[0]:.2f} to {focal[-1]:.2f} widths of the image.")
    if 0 < len(subject.photos) < AT_LEAST:
        yield Finding("cameras", "warning", f"{len(subject.photos)} images are few: new views will be poor.")
    if len(subject.photos) > 1:
        centers = np.array([photo.camera.center for photo in subject.photos])
        away, spread = np.abs(centers).max(), np.ptp(centers, axis=0).max()
        if spread <= 1e-9 * away and not len(subject.points):
            yield Finding("coverage", "warning", "all cameras stand at one place, from where depth cannot be seen.")
        elif far := too_far(subject.photos):
            yield Finding("coordinates", "warning", far)


def check_coordinates(subject: Subject) -> Iterator[Finding]:
    """Where the scene is in the world, and how well positions that were given for its photographs fit."""
    try:
        found = read_coordinates(subject.source)
    except InputError as error:
        yield Finding("coordinates", "error", str(error))
        return
    if found is None:
        return
    left_out, residuals = found.get("left_out", []), dict(found.get("residuals", {}))
    fitting = sorted((size, name) for name, size in residuals.items() if name not in left_out)
    text = f"{found.get('reference')}, origin at {', '.join(f'{x:.12g}' for x in found['origin'])}"
    if fitting:
        half, (worst, name) = np.median([size for size, _ in fitting]), fitting[-1]
        text += f"; {len(fitting)} fit within {half:.2g} m (median), the worst, {name}, within {worst:.2g} m"
    rest = f"; {len(left_out)} were left out: {few(map(str, left_out))}" if left_out else ""
    yield Finding("coordinates", "warning" if left_out else "ok", f"{text}{rest}.")


def check_names(subject: Subject) -> Iterator[Finding]:
    """Names that occur twice, images that are the same file, images that no camera belongs to."""
    stems: dict[str, list[str]] = defaultdict(list)
    copies: dict[bytes, list[str]] = defaultdict(list)
    for photo in subject.photos:
        stems[str(Path(photo.name).with_suffix("")).lower()].append(photo.name)
        copies[hashlib.sha256(photo.path.read_bytes()).digest()].append(photo.name)
    kinds = {"the same name but for ending or case": stems, "the same bytes": copies}
    twice = {kind: [" = ".join(n) for n in groups.values() if len(n) > 1] for kind, groups in kinds.items()}
    for kind, names in twice.items():
        if names:
            yield Finding("duplicates", "warning", f"{len(names)} groups of images have {kind}: {few(names)}.")
    if subject.photos and not any(twice.values()):
        yield Finding("duplicates", "ok", "no image occurs twice.")
    if subject.model is not None and subject.root.is_dir():
        known = {subject.model.image(i).name for i in subject.model.reg_image_ids()}
        known |= {photo.path.relative_to(subject.root).as_posix() for photo in subject.photos}  # found by their stems
        if extra := [name for name in find_files(subject.root, READABLE) if name not in known]:
            text = f"{len(extra)} images in {subject.root} have no camera and are not used: {few(extra)}."
            yield Finding("unregistered", "note", text)


def check_masks(subject: Subject) -> Iterator[Finding]:
    """Alpha channels and masks."""
    count, alpha, black = len(subject.photos), len(subject.alpha), len(subject.black)
    without = [photo.name for photo in subject.photos if photo.mask is None]
    masked = len(without) < count or (subject.source / MASKS).is_dir()
    if alpha:
        text = f"{alpha} of {count} images have alpha: black behind them, with -w white."
        yield Finding("alpha", "warning" if alpha < count else "note", text)
    if masked:
        rest = f"; none for {few(without)}" if without else ""
        text = f"there are masks for {count - len(without)} of {count} images{rest}."
        yield Finding("masks", "warning" if without else "ok", text)
    if black:
        yield Finding("masks", "note", f"the masks of {black} images are black, which leaves out {few(subject.black)}.")
    if not (alpha or masked or black):
        yield Finding("masks", "ok", "no alpha channels and no masks.")


def check_contents(subject: Subject) -> Iterator[Finding]:
    """Photographs that show nothing, as those of a covered lens."""
    if plain := [name for name, small in subject.thumbnails.items() if (small == small[0, 0]).all()]:
        text = f"{len(plain)} of {len(subject.photos)} images have one color all over: {few(plain)}."
        yield Finding("contents", "warning", text)


def check_loading(subject: Subject) -> Iterator[Finding]:
    """What training itself would say of this scene before its first step."""
    notes: list[str] = []
    try:
        train, _, points, _ = read_photos(subject.source, subject.folder, notes.append)
        if len(points):
            require_visible(train, points, subject.source)
            if near := too_near(train, points):
                yield Finding("points", "warning", near)
        if subject.thumbnails:
            require_one_kind([(name, name in subject.linear) for name in subject.thumbnails], subject.source)
            require_unmasked(len(subject.photos), len(subject.black), subject.source)
        if unread := len({photo.name for photo in subject.photos}) - len(subject.thumbnails):
            raise InputError(f"{unread} images cannot be read.")
    except InputError as error:
        yield Finding("loading", "error", f"training would refuse this scene: {error}")
        return
    yield Finding("loading", "ok", "training would accept this scene.")
    if not len(points):
        yield Finding("points", "warning", "there are none; training takes random ones, which trains worse.")
    yield from (Finding("loading", "note", note) for note in notes)


#: What is checked once the points are: see geometry.py.
CHECKS = (check_coordinates, check_names, check_masks, check_contents, check_loading)
