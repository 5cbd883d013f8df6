"""Camera against hand-computed geometry."""

import numpy as np
import pytest

from warp_splat.camera import Camera
from warp_splat.errors import InputError

TURN = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # looks along the world's +x
FIELDS = {
    "width": 40,
    "height": 30,
    "fx": 50.0,
    "fy": 60.0,
    "cx": 18.0,
    "cy": 16.0,
    "rotation": TURN,
    "translation": (0.0, 0.0, 2.0),
}


def test_center_and_forward():
    camera = Camera(**FIELDS)
    np.testing.assert_allclose(camera.rotation @ camera.center + camera.translation, 0, atol=1e-12)
    np.testing.assert_allclose(camera.center, (-2, 0, 0))
    np.testing.assert_allclose(camera.forward, (1, 0, 0))


def test_resized_scales_all_of_k():
    small = Camera(**FIELDS).resized(20, 10)
    assert (small.width, small.height) == (20, 10)
    np.testing.assert_allclose((small.fx, small.fy, small.cx, small.cy), (25, 20, 9, 16 / 3))
    np.testing.assert_array_equal(small.rotation, TURN)


def test_camera_copies_what_it_is_given():
    rotation = TURN.copy()
    camera = Camera(**{**FIELDS, "rotation": rotation})
    rotation[:] = 0
    np.testing.assert_array_equal(camera.rotation, TURN)
    with pytest.raises(ValueError, match="read-only"):
        camera.rotation[0, 0] = 2


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("width", 0),
        ("height", 2.5),
        ("fx", 0.0),
        ("fy", -3.0),
        ("cx", np.nan),
        ("cy", np.inf),
        ("rotation", np.eye(4)),
        ("rotation", np.full((3, 3), np.nan)),
        ("rotation", np.diag((1.0, 1.0, -1.0))),
        ("rotation", 2 * np.eye(3)),
        ("translation", (0.0, 0.0)),
        ("translation", (0.0, np.inf, 0.0)),
    ],
)
def test_bad_value_is_named(field, value):
    with pytest.raises(InputError, match=f"^Camera {field}: expected") as caught:
        Camera(**{**FIELDS, field: value})
    assert str(caught.value).endswith(".")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0, -3, 2.5])
def test_size_that_is_no_size(value):
    with pytest.raises(InputError, match="width"):
        Camera(value, 10, 1.0, 1.0, 0.0, 0.0, np.eye(3), np.zeros(3))
