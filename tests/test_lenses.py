"""Lenses: the formulas against COLMAP's, their inverse, and where they fold."""

import numpy as np
import pytest

from warp_splat.lenses import Lens
from warp_splat.lenses.formulas import MODELS

pycolmap = pytest.importorskip("pycolmap")

SMALL = (0.06, -0.03, 0.004, -0.006, 0.02, -0.01, 0.015, 0.005, 0.003, -0.002, 0.004, 0.001)
COEFFICIENTS = {"FOV": (0.9,), "EUCM": (0.6, 1.1)}
LENSES = {model: Lens(model, COEFFICIENTS.get(model, SMALL[:count])) for model, (_, count) in MODELS.items()}


def colmap_camera(lens):
    """COLMAP's camera with focal length 1 and the principal point at 0; a panorama has neither."""
    if lens.model == "EQUIRECTANGULAR":
        return pycolmap.Camera(model=lens.model, width=200, height=100, params=[200, 100])
    camera = pycolmap.Camera.create_from_model_name(0, lens.model, 1.0, 100, 100)
    focals = len(camera.focal_length_idxs())
    camera.params = [1.0] * focals + [0.0, 0.0, *lens.coefficients]
    return camera


def directions(most, count=300, least_z=0.05):
    """Unit vectors up to an angle from the axis, those that COLMAP sees."""
    rng = np.random.default_rng(1)
    angle, around = rng.uniform(0, most, count), rng.uniform(0, 2 * np.pi, count)
    angle[:3] = 0, 1e-9, 1e-4
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], 1)
    return rays[rays[:, 2] > least_z]


@pytest.mark.parametrize("model", MODELS)
def test_lenses_show_points_where_colmap_does(model):
    lens, camera = LENSES[model], colmap_camera(LENSES[model])
    rays = directions(lens.limit, least_z=-1 if model == "EQUIRECTANGULAR" else 0.05)
    wanted = camera.img_from_cam(5.0 * rays)
    if model == "EQUIRECTANGULAR":
        wanted = (wanted - [100, 50]) * np.pi / 100
    found = lens.distorted(5.0 * rays)
    assert len(rays) > 100
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_what_a_lens_shows_is_found_again(model):
    lens = LENSES[model]
    rays = directions(0.98 * lens.limit, least_z=-1 if lens.family.wide else 0.05)
    np.testing.assert_allclose(lens.undistorted(lens.distorted(rays)), rays, atol=1e-7)
