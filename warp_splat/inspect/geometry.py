"""Checks of photographs against points: reprojection, coverage, a sky, how bright they are, axes that are mixed up."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from warp_splat.camera import Camera, mean_up
from warp_splat.errors import InputError
from warp_splat.formats.coordinates import UP, read_coordinates
from warp_splat.inspect.subject import Finding, Subject
from warp_splat.scene import gains as brightness
from warp_splat.scene import horizon
from warp_splat.scene.images import read_exposure
from warp_splat.scene.types import visible
from warp_splat.text import few

VIEWS = 60  # at most, in checks that take time for each
POINTS = 20_000  # at most, likewise
GOOD, BAD = 2e-3, 3e-2  # median reprojection error, as a share of the image's width: 2 and 30 px at 1000
WORSE = 3.0  # times the median image's error is worth a warning
FEW_POINTS = 50  # in an image
UNSEEN = 0.05  # share of points outside all images that is worth a warning
FAR = 1000.0  # times the median distance
STILL = 1e-3  # spread of the cameras against their distance to the points: turning on the spot
BETTER = 4.0  # times more points seen with other axes
GAP = 120.0  # degrees


def sample(items: Any, count: int) -> Any:
    """At most ``count`` of the items of a list or an array, evenly."""
    return items[:: max(1, -(-len(items) // count))]


def check_reprojection(subject: Subject) -> Iterator[Finding]:
    """Points projected into images, against the keypoints from which they were triangulated."""
    if (model := subject.model) is None:
        return
    names = {photo.name for photo in subject.photos}
    registered = [model.image(i) for i in sorted(model.reg_image_ids())]
    widths = {}
    for image in sample([image for image in registered if image.name in names], VIEWS):
        seen = [point for point in image.get_observation_points2D() if model.exists_point3D(point.point3D_id)]
        pairs = [(point.xy, xyz) for point in seen if np.isfinite(xyz := model.point3D(point.point3D_id).xyz).all()]
        if not pairs:
            continue
        keypoints, xyz = (np.array(column, np.float64) for column in zip(*pairs, strict=True))
        in_camera = image.cam_from_world() * xyz
        front = in_camera[:, 2] > 0
        errors = np.full(len(xyz), np.inf)  # a point behind the camera that observed it
        errors[front] = np.linalg.norm(image.camera.img_from_cam(in_camera[front]) - keypoints[front], axis=1)
        subject.errors[image.name], subject.pixels[image.name] = errors, keypoints
        widths[image.name] = image.camera.width
    if not subject.errors:
        yield Finding("reprojection", "note", "the model keeps no observations of its points; look at the picture.")
        return
    medians = subject.medians
    every = np.concatenate(list(subject.errors.values()))
    typical, width = float(np.median(every)), float(np.median(list(widths.values())))
    behind = np.count_nonzero(~np.isfinite(every))
    level, meaning = "ok", ""
    if not typical <= BAD * width or behind > 0.2 * len(every):
        level, meaning = "error", f", {behind} of them behind a camera: poses and points do not belong together"
    elif typical > max(GOOD * width, 1.0):
        level, meaning = "warning", ": views will blur, since the cameras are imprecise"
    text = f"median {typical:.2f} px over {len(every)} observations in {len(medians)} images of {width:.0f} px"
    yield Finding("reprojection", level, f"{text}{meaning}.")
    if worst := [n for n in sorted(medians, key=lambda n: -medians[n]) if medians[n] > max(WORSE * typical, 1.0)]:
        text = few(f"{name} ({medians[name]:.1f} px)" for name in worst)
        yield Finding("reprojection", "warning", f"{len(worst)} images are much worse than the others: {text}.")


def check_coverage(subject: Subject) -> Iterator[Finding]:
    """Points in each image, points in no image, cameras all at one place, sides that nobody photographed."""
    if not subject.photos or not len(subject.points):
        return
    points = sample(subject.points, POINTS)
    inside = np.array([visible(photo.camera, points) for photo in subject.photos])
    counts, seen = inside.sum(0), np.rint(len(subject.points) / len(points) * inside.sum(1))
    poor = [photo.name for photo, number in zip(subject.photos, seen, strict=True) if number < FEW_POINTS]
    text = f", each point inside {np.median(counts):.0f} of {len(subject.photos)}"
    text = f", but fewer than {FEW_POINTS} in {few(poor)}" if poor else text
    median = f"{np.median(seen):.0f} points lie inside the median image"
    yield Finding("coverage", "warning" if poor else "ok", f"{median}{text}.")
    unseen = np.count_nonzero(counts == 0) / len(points)
    level = "error" if unseen == 1 else "warning" if unseen > UNSEEN and not subject.random_points else "ok"
    yield Finding("unseen points", level, f"{100 * unseen:.1f} % of the points lie outside every image.")
    yield from _check_spread(subject, points)


def check_sky(subject: Subject) -> Iterator[Finding]:
    """How much of the photographs looks up to where there are no points."""
    if subject.photos and len(subject.points) and not subject.random_points:
        cameras, known = [photo.camera for photo in subject.photos], None
        with suppress(InputError):  # said elsewhere
            known = read_coordinates(subject.source)
        share = horizon.share_of_sky(cameras, subject.points, UP if known else mean_up(cameras))
        text = f"{100 * share:.1f} % of the photographs look up to where there are no points"
        needed = share >= horizon.NEEDED
        yield Finding("sky", "note" if needed else "ok", f"{text}{': train with --parts sky' * needed}.")


def check_exposure(subject: Subject) -> Iterator[Finding]:
    """Gains of photographs along the tracks of points, from their thumbnails."""
    if subject.model is None:
        return
    samples = {}
    for image in (subject.model.image(i) for i in subject.model.reg_image_ids()):
        seen = image.get_observation_points2D()
        if image.name in subject.thumbnails and seen:
            places = np.array([point.xy for point in seen]) / (image.camera.width, image.camera.height)
            ids = np.array([point.point3D_id for point in seen], np.int64)
            samples[image.name] = brightness.take_sample(subject.thumbnails[image.name], ids, places)
    if not (gains := brightness.fit_gains(samples)).stops:
        yield Finding("exposure", "note", "photographs share too few points to compare how bright they are.")
        return
    subject.stops = {name: float(gains.stops[name][brightness.GREEN]) for name in sorted(gains.stops)}
    subject.exif = _exif(subject)
    least, most = (choose(subject.stops, key=lambda name: subject.stops[name]) for choose in (min, max))
    text = (
        f"photographs differ by {gains.unlike:.3f} stops from those that show the same points: "
        f"{subject.stops[least]:+.2f} ({least}) to {subject.stops[most]:+.2f} ({most}) in all"
    )
    if subject.exif:
        apart = np.array([subject.stops[name] - stops for name, stops in subject.exif.items()])
        count = f"{len(subject.exif)} of {len(subject.stops)}"
        text += f"; EXIF has the exposure of {count}, {apart.std():.2f} stops beside that (standard deviation)"
    else:
        text += "; EXIF says nothing"
    needed = gains.unlike >= brightness.NEEDED
    yield Finding("exposure", "warning" if needed else "ok", f"{text}{'; train with --parts exposure' * needed}.")


def _exif(subject: Subject) -> dict[str, float]:
    """The exposures that files tell [stops], shifted to the mean of those that were measured."""
    told = {}
    for photo in subject.photos:
        with suppress(InputError):  # said elsewhere
            if photo.name in subject.stops and (stops := read_exposure(photo.path)) is not None:
                told[photo.name] = stops
    shift = np.mean([subject.stops[name] - stops for name, stops in told.items()] or [0.0])
    return {name: float(stops + shift) for name, stops in told.items()}


def _check_spread(subject: Subject, points: np.ndarray) -> Iterator[Finding]:
    centers = np.array([photo.camera.center for photo in subject.photos])
    middle = np.median(points, axis=0)
    distances = np.linalg.norm(points - middle, axis=1)
    if np.median(distances) > 0 and (far := np.count_nonzero(distances > FAR * np.median(distances))):
        yield Finding("points", "warning", f"{far} of {len(points)} points are {FAR:.0f} times as far away as most.")
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    reach = np.median(np.linalg.norm(points - centers.mean(axis=0), axis=1))
    if len(centers) > 1 and spread < STILL * reach:
        yield Finding("coverage", "warning", "all cameras stand at one place, from where depth cannot be seen.")
    elif len(centers) > 2:
        _, _, axes = np.linalg.svd(centers - centers.mean(axis=0))
        around = np.sort(np.arctan2(*(axes[:2] @ (centers - middle).T)))
        if (gap := np.degrees(np.diff(np.append(around, around[0] + 2 * np.pi)).max())) > GAP:
            yield Finding("coverage", "note", f"nobody photographed from {gap:.0f} of the 360 degrees around.")


def check_axes(subject: Subject) -> Iterator[Finding]:
    """How many points the images would show if the poses were read in other conventions."""
    if not subject.photos or not len(subject.points):
        return
    points, photos = sample(subject.points, 2000), sample(subject.photos, VIEWS)
    seen = {name: sum(visible(turn(photo.camera), points).sum() for photo in photos) for name, turn in TURNS.items()}
    best = max(seen, key=lambda name: seen[name])
    shares = ", ".join(f"{name} {100 * count / (len(points) * len(photos)):.0f} %" for name, count in seen.items())
    if seen[best] > BETTER * seen["as stored"]:
        yield Finding("axes", "error", f"with {best} the images show more points ({shares}); the axes are mixed up.")
    else:
        yield Finding("axes", "ok", f"no other convention would show many more points ({shares}).")


def _inverted(camera: Camera) -> Camera:
    return replace(camera, rotation=camera.rotation.T, translation=camera.center)


def _turned(camera: Camera) -> Camera:
    flip = np.diag((1.0, -1.0, -1.0))
    return replace(camera, rotation=flip @ camera.rotation, translation=flip @ camera.translation)


TURNS = {
    "as stored": lambda camera: camera,
    "OpenGL axes": _turned,
    "camera-to-world": _inverted,
    "camera-to-world in OpenGL axes": lambda camera: _turned(_inverted(camera)),
}


#: In an order in which later ones may use what earlier ones measured.
CHECKS = (check_reprojection, check_coverage, check_sky, check_axes, check_exposure)
