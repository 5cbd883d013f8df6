"""The page of ``inspect``, one HTML file, and its pictures: thumbnails, points on photographs, a map of cameras."""

import base64
import io
import math
from collections.abc import Callable, Iterable
from functools import partial
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np
from matplotlib.figure import Figure

from warp_splat.evaluation.report import BLUE, INK, ORANGE, TALLEST, WIDTH, new_figure, new_panels, plain_axes
from warp_splat.formats.files import write_text
from warp_splat.inspect.geometry import sample
from warp_splat.inspect.subject import THUMBNAIL, Finding, Subject
from warp_splat.scene.images import Photo
from warp_splat.scene.types import visible

SHEET, COLUMNS = 60, 10  # thumbnails, at most, and in a row
WORST = 3  # photographs with points on them, and as many others
DOTS = 1500  # points drawn on a photograph
MOST = 3.0  # px; larger errors have the same color
MAPPED = 5000  # points drawn on the map
PAGE_DPI = 110
Captioned = Iterable[tuple[str, str]]  # captions, and addresses with the pictures themselves


def write_page(path: Path, title: str, verdict: str, findings: list[Finding], pictures: Captioned) -> None:
    """Write the verdict, a row for each finding, and the pictures (captions, addresses of data).

    Raises:
        InputError: if the file cannot be written.
    """
    rows = "\n".join(
        f'<tr><td class="{finding.level}">{finding.level}</td><td>{escape(finding.check)}</td>'
        f"<td>{escape(finding.text)}</td></tr>"
        for finding in findings
    )
    figures = "\n".join(
        f'<figure><figcaption>{escape(caption)}</figcaption><img src="{address}" alt="{escape(caption)}"></figure>'
        for caption, address in pictures
    )
    page = Template(resources.files("warp_splat.inspect").joinpath("page.html").read_text(encoding="utf-8"))
    write_text(path, page.substitute(title=escape(title), verdict=escape(verdict), rows=rows, figures=figures))


def draw_pictures(subject: Subject) -> Captioned:
    """Captions and pictures, as addresses of data that a page holds itself."""
    if not (shown := [photo for photo in subject.photos if photo.name in subject.thumbnails]):
        return
    yield "The photographs, evenly chosen", _encode(_sheet(subject, [photo.name for photo in sample(shown, SHEET)]))
    if not len(subject.points):
        return
    caption = "Points projected into photographs: they should lie on what is there"
    if subject.errors:
        caption = "Where points were seen, colored by how far from there they project (the worst images first)"
    yield caption, _encode(_on_photos(subject, shown))
    yield "Cameras (with their viewing directions) and points, from two sides", _encode(_map(subject))
    if subject.errors:
        yield "Reprojection error and points of each image, by name", _encode(_bars(subject))
    if subject.stops:
        yield "Exposure of each photograph beside the others, by name", _encode(_exposures(subject))


def address_of(kind: str, save: Callable[[io.BytesIO], object]) -> str:
    """A picture that ``save`` writes, "png" or "jpeg", as an address of data."""
    save(buffer := io.BytesIO())
    return f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _encode(figure: Figure) -> str:
    return address_of("jpeg", partial(figure.savefig, format="jpg", dpi=PAGE_DPI, pil_kwargs={"quality": 85}))


def _sheet(subject: Subject, names: list[str]) -> Figure:
    """Thumbnails in rows of COLUMNS with their names above: one picture, since each set of axes takes long."""
    height, width = (max(subject.thumbnails[name].shape[side] for name in names) for side in (0, 1))
    gap, rows = THUMBNAIL // 8, math.ceil(len(names) / COLUMNS)
    sheet = np.full((rows * (height + gap), COLUMNS * (width + gap), 3), 255, np.uint8)
    figure = new_figure(WIDTH, WIDTH * sheet.shape[0] / sheet.shape[1])
    axes = figure.add_axes((0, 0, 1, 1))
    for index, name in enumerate(names):
        top, left = index // COLUMNS * (height + gap) + gap, index % COLUMNS * (width + gap)
        small = subject.thumbnails[name]
        sheet[top : top + small.shape[0], left : left + small.shape[1]] = small
        axes.text(left, top - 4, name[-14:], fontsize=5, color=INK, parse_math=False)
    axes.imshow(sheet)
    axes.set_axis_off()
    return figure


def _on_photos(subject: Subject, shown: list[Photo]) -> Figure:
    """The worst photographs by reprojection error, as many evenly from the others."""
    ranked = sorted(shown, key=lambda photo: -subject.medians.get(photo.name, 0.0))
    photos = ranked[:WORST] + sample(ranked[WORST:], WORST)
    height, width = subject.thumbnails[photos[0].name].shape[:2]
    columns, dots = 3 if height > width else 2, None
    rows = math.ceil(len(photos) / columns)
    figure, grid = new_panels(rows * (WIDTH / columns * min(height / width, TALLEST) * 0.97 + 0.2), rows, columns)
    cells = list(np.ravel(grid))
    for axes in cells:
        axes.set_axis_off()
    for axes, photo in zip(cells, photos, strict=False):
        small = subject.thumbnails[photo.name]
        axes.imshow(small, alpha=0.7)
        if photo.name in subject.errors:
            image = subject.model.find_image_with_name(photo.name)
            pixels = subject.pixels[photo.name][:DOTS] * small.shape[1] / image.camera.width
            errors = subject.errors[photo.name]
            dots = axes.scatter(*pixels.T, c=errors[:DOTS], s=2, cmap="plasma", vmin=0, vmax=MOST)
            title = f"{photo.name}: median {np.median(errors):.2f} px"
        else:
            points = sample(subject.points[visible(photo.camera, subject.points)], DOTS)
            pixels = photo.camera.pixels(points @ photo.camera.rotation.T + photo.camera.translation)
            axes.scatter(*pixels.T * small.shape[1] / photo.camera.width, c=ORANGE, s=1.5)
            title = photo.name
        axes.set_title(title, fontsize=7, color=INK, pad=2, parse_math=False)
        axes.set(xlim=(0, small.shape[1]), ylim=(small.shape[0], 0))
    if dots is not None:
        bar = figure.colorbar(dots, ax=cells[: len(photos)], shrink=0.4, aspect=40, location="bottom")
        bar.set_label("reprojection error [px]", fontsize=7)
    return figure


def _map(subject: Subject) -> Figure:
    """Across the plane in which the cameras spread most, and from its side."""
    centers = np.array([photo.camera.center for photo in subject.photos])
    forward = np.array([photo.camera.forward for photo in subject.photos])
    points = sample(subject.points, MAPPED)
    middle = np.median(points, axis=0)
    _, _, axes_of_spread = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=True)
    reach = 1.3 * np.percentile(np.linalg.norm(np.concatenate([centers, points]) - middle, axis=1), 95)
    figure, grid = new_panels(WIDTH / 2 + 0.3, 1, 2)
    sides = (("in the plane of the cameras", (0, 1)), ("across it", (0, 2)))
    for axes, (title, chosen) in zip(grid[0], sides, strict=True):
        plane = axes_of_spread[list(chosen)].T
        plain_axes(axes, title)
        axes.scatter(*((points - middle) @ plane).T, s=0.5, color=BLUE, alpha=0.4)
        axes.quiver(*((centers - middle) @ plane).T, *(forward @ plane).T, color=ORANGE, width=0.004, scale=25)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    return figure


def _bars(subject: Subject) -> Figure:
    figure, grid = new_panels(2.6, 1, 2)
    medians = list(subject.medians.values())
    counts = [len(errors) for errors in subject.errors.values()]
    panels = (("median reprojection error [px]", medians, ORANGE), ("observations", counts, BLUE))
    for axes, (title, values, color) in zip(grid[0], panels, strict=True):
        plain_axes(axes, title, "image")
        axes.bar(range(len(values)), values, color=color)
    return figure


def _exposures(subject: Subject) -> Figure:
    figure, axes = new_panels(2.6)
    places = {name: place for place, name in enumerate(subject.stops)}
    plain_axes(axes, "brightness of the same points [stops]", "photograph")
    axes.bar(places.values(), subject.stops.values(), color=BLUE, label="measured")
    if subject.exif:
        axes.scatter([places[name] for name in subject.exif], subject.exif.values(), 12, ORANGE, label="EXIF", zorder=2)
        axes.legend(fontsize=7)
    return figure
