"""The pictures of the documentation that no benchmark makes: `python docs/make_pictures.py sheet -m output/abc123`."""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from warp_splat.cli import main
from warp_splat.formats.model_folder import find_iteration
from warp_splat.formats.png import load_png
from warp_splat.report import new_figure, save_figure

IMAGES = Path(__file__).parent / "images"
SHOWN = 6  # frames of each video


def sheet(model: str) -> Path:
    """The worst and the best held-out views, as training left them, smaller."""
    iteration = find_iteration(model)
    assert main(["render", "-m", model, "--skip_train", "--iteration", str(iteration)]) == 0
    return _save(load_png(Path(model) / "contact_sheet.png"), "contact_sheet.jpg")


def videos(model: str) -> Path:
    """Frames of each kind of video, a row for each."""
    rows = []
    for video in ("orbit", "spiral", "path"):
        with tempfile.TemporaryDirectory() as folder:
            options = ["--video", video, "--frames", str(SHOWN * 10), "--video_output", folder]
            assert main(["render", "-m", model, *options]) == 0
            frames = sorted(Path(folder).iterdir())[5::10]
            rows.append(np.concatenate([load_png(frame) for frame in frames], axis=1))
    return _save(np.concatenate(rows), "videos.jpg")


def _save(picture: np.ndarray, name: str) -> Path:
    """As a JPEG file of about the width of a page."""
    height, width, _ = picture.shape
    figure = new_figure(5.0, 5.0 * height / width)
    figure.add_axes((0, 0, 1, 1)).imshow(picture, interpolation="lanczos")
    figure.axes[0].set_axis_off()
    save_figure(figure, IMAGES / name)
    return IMAGES / name


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture", choices=("sheet", "videos"))
    parser.add_argument("-m", "--model", required=True, help="a model trained on the embedded scene")
    arguments = parser.parse_args()
    print({"sheet": sheet, "videos": videos}[arguments.picture](arguments.model))
