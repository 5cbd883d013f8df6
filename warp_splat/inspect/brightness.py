"""Check of exposure: whether photographs show the same points as bright, and what EXIF says."""

from collections.abc import Iterator

import numpy as np

from warp_splat.errors import InputError
from warp_splat.inspect.geometry import Measured
from warp_splat.inspect.subject import Finding, Subject
from warp_splat.scene.gains import GREEN, NEEDED, fit_gains, take_sample
from warp_splat.scene.images import read_exposure


def check_exposure(subject: Subject, measured: Measured) -> Iterator[Finding]:
    """Gains of photographs along the tracks of points, from their thumbnails."""
    if subject.model is None:
        return
    samples = {}
    for image in (subject.model.image(i) for i in subject.model.reg_image_ids()):
        seen = image.get_observation_points2D()
        if image.name in subject.thumbnails and seen:
            places = np.array([point.xy for point in seen]) / (image.camera.width, image.camera.height)
            ids = np.array([point.point3D_id for point in seen], np.int64)
            samples[image.name] = take_sample(subject.thumbnails[image.name], ids, places)
    gains = fit_gains(samples)
    if not gains.stops:
        yield Finding("exposure", "note", "photographs share too few points to compare how bright they are.")
        return
    measured.stops = {name: float(gains.stops[name][GREEN]) for name in sorted(gains.stops)}
    measured.exif = dict(_exif(subject, measured))
    least, most = (choose(measured.stops, key=lambda name: measured.stops[name]) for choose in (min, max))
    text = (
        f"photographs differ by {gains.unlike:.3f} stops from those that show the same points: "
        f"{measured.stops[least]:+.2f} ({least}) to {measured.stops[most]:+.2f} ({most}) in all"
    )
    if measured.exif:
        apart = np.array([measured.stops[name] - stops for name, stops in measured.exif.items()])
        count = f"{len(measured.exif)} of {len(measured.stops)}"
        text += f"; EXIF has the exposure of {count}, {apart.std():.2f} stops beside that (standard deviation)"
    else:
        text += "; EXIF says nothing"
    needed = gains.unlike >= NEEDED
    yield Finding("exposure", "warning" if needed else "ok", f"{text}{'; train with --parts exposure' * needed}.")


def _exif(subject: Subject, measured: Measured) -> Iterator[tuple[str, float]]:
    """The exposures that files tell [stops], shifted to the mean of those that were measured."""
    told = {}
    for photo in subject.photos:
        try:
            stops = read_exposure(photo.path)
        except InputError:  # said elsewhere
            continue
        if stops is not None and photo.name in measured.stops:
            told[photo.name] = stops
    if told:
        shift = np.mean([measured.stops[name] - stops for name, stops in told.items()])
        yield from ((name, float(stops + shift)) for name, stops in told.items())
