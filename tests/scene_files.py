"""Small scenes in files, for the tests of the loader: COLMAP models as text, nerf-synthetic folders, images."""

import json

import numpy as np
import OpenImageIO as oiio
import pycolmap
from scipy.spatial.transform import Rotation

from warp_splat.formats.ply import save_points
from warp_splat.scene import load_scene

WIDTH, HEIGHT = 48, 32
PINHOLE = f"PINHOLE {WIDTH} {HEIGHT} 40 44 22.5 17.25"
POINTS = np.random.default_rng(1).uniform(-1, 1, (20, 3))
COLORS = np.random.default_rng(2).integers(0, 256, (20, 3))
LENS = {"w": WIDTH, "h": HEIGHT, "fl_x": 40.0, "fl_y": 44.0, "cx": 22.5, "cy": 17.25}


def pose(index):
    """A camera_from_world that sees the unit cube at the origin."""
    return Rotation.from_euler("xyz", (0.1, 0.25 * index, -0.05)).as_matrix(), np.array((0.1, -0.1, 5.0 + 0.1 * index))


def write_image(path, pixels, attributes=(), kind=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind or str(pixels.dtype))
    if pixels.shape[2] in (2, 4):
        spec.channelnames = "YA" if pixels.shape[2] == 2 else "RGBA"
        spec.alpha_channel = pixels.shape[2] - 1
    spec.attribute("oiio:UnassociatedAlpha", 1)
    for name, value in attributes:
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec) and output.write_image(pixels) and output.close(), output.geterror()


def texture(width=WIDTH, height=HEIGHT, channels=3, dtype=np.uint8):
    noise = np.random.default_rng(3).integers(0, np.iinfo(dtype).max + 1, (height, width, channels))
    return noise.astype(dtype)


def radial(x, y, k1, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0):
    """COLMAP's (and OpenCV's) radial and tangential distortion of normalized coordinates; OpenCV's rational model."""
    r2 = x * x + y * y
    factor = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * factor + 2 * p2 * x * y + p1 * (r2 + 2 * y * y))


def fisheye(x, y, k1=0.0, k2=0.0, k3=0.0, k4=0.0):
    """OpenCV's equidistant fisheye model."""
    r = np.hypot(x, y)
    t = np.arctan(r)
    bent = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)
    return x * bent / r, y * bent / r


def thin_prism(x, y, k1, k2, p1, p2, k3, k4, s1, s2):
    """Weng et al. 1992 on the angles of a fisheye, in COLMAP's order of the parameters."""
    x, y = fisheye(x, y)
    dx, dy = radial(x, y, k1, k2, p1, p2, k3)
    r2 = x * x + y * y
    return dx + x * k4 * r2**4 + s1 * r2, dy + y * k4 * r2**4 + s2 * r2


def field_of_view(x, y, omega):
    """Devernay and Faugeras 2001."""
    r = np.hypot(x, y)
    factor = np.arctan(2 * r * np.tan(omega / 2)) / (r * omega)
    return x * factor, y * factor


def pattern(x, y):
    """A smooth picture on the plane at depth 1, 0..1."""
    return np.stack([0.5 + 0.4 * np.sin(9 * x), 0.5 + 0.4 * np.cos(8 * y), 0.5 + 0.4 * np.sin(6 * (x + y))], axis=-1)


def distorted_picture(distort, params, width, height, fx, fy, cx, cy):
    """What a lens shows of the pattern, in 16 bits."""
    v, u = np.mgrid[:height, :width] + 0.5
    goal = (u - cx) / fx, (v - cy) / fy
    x, y = goal
    for _ in range(200):  # the fixed point of x = x + goal - distort(x)
        bent = distort(x, y, *params)
        x, y = x + goal[0] - bent[0], y + goal[1] - bent[1]
    np.testing.assert_allclose(distort(x, y, *params), goal, atol=1e-9)
    return np.rint(pattern(x, y) * 65535).astype(np.uint16)


def check_ideal(view, error_most=0.52):
    """A view shows the pattern as a pinhole would, within so many levels of 255; quantization alone gives 0.5."""
    camera = view.camera
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    ideal = pattern((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy) * 255
    assert view.image.shape == ideal.shape
    error = np.abs(view.image - ideal)
    assert error[2:-2, 2:-2].max() < error_most
    assert error.max() < error_most + 0.2  # the outermost pixels may lie half a pixel outside of the file


def write_model(folder, names, camera=PINHOLE, points=POINTS, binary=False):
    """A COLMAP model in the documented text format; pycolmap turns it into a binary one."""
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"# cameras\n1 {camera}\n")
    lines = ["# images"]
    for index, name in enumerate(names):
        rotation, translation = pose(index)
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        numbers = " ".join(repr(float(value)) for value in (w, x, y, z, *translation))
        lines += [f"{index + 1} {numbers} 1 {name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [
        " ".join(map(str, (i + 1, *map(float, point), *map(int, color), 0.5)))
        for i, (point, color) in enumerate(zip(points, COLORS, strict=False))
    ]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")
    if binary:
        model = pycolmap.Reconstruction(folder)
        for index, name in enumerate(names):
            model.image(index + 1).name = name  # pycolmap's text reader cuts it at a space
        for path in folder.iterdir():
            path.unlink()
        model.write_binary(folder)


def write_colmap(root, names=("a.png", "b.png", "c.png"), pixels=None, images="images", **model):
    write_model(root / "sparse" / "0", names, **model)
    for name in names:
        write_image(root / images / name, texture() if pixels is None else pixels)
    return root


def look_at_origin(center):
    """world_from_camera in OpenGL axes (x right, y up, z backward), the world's z up."""
    backward = center / np.linalg.norm(center)
    right = np.cross((0, 0, 1), backward)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, np.cross(backward, right), backward, center])
    return matrix


def write_blender(root, train=2, test=1, pixels=None):
    for split, count in (("train", train), ("test", test)):
        frames = []
        for index in range(count):
            write_image(root / split / f"r_{index}.png", texture() if pixels is None else pixels)
            matrix = look_at_origin(np.array((4.0, -1.0 + index, 1.5)))
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": matrix.tolist()})
        content = {"camera_angle_x": 0.7, "frames": frames}
        if count:
            (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return root


def project(camera, points):
    x, y, z = camera.rotation @ np.asarray(points, float).T + camera.translation[:, None]
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)


def load(root, **options):
    lines = []
    return load_scene(root, report=lines.append, **options), lines


def change_json(root, change, name="transforms_train.json"):
    content = json.loads((root / name).read_text())
    change(content)
    (root / name).write_text(json.dumps(content))


def scale_axes(content, factors):
    matrix = np.array(content["frames"][0]["transform_matrix"])
    matrix[:3, :3] *= factors
    content["frames"][0]["transform_matrix"] = matrix.tolist()


def write_transforms(root, names=("images/a.png", "images/b.png"), pixels=None, frame=None, points=True, **values):
    """A nerfstudio scene; ``frame`` changes the frame of an index."""
    frames = []
    for index, name in enumerate(names):
        write_image(root / name, texture() if pixels is None else pixels)
        matrix = look_at_origin(np.array((4.0, -1.0 + index, 1.5)))
        frames.append({"file_path": name, "transform_matrix": matrix.tolist(), **(frame(index) if frame else {})})
    if points:
        save_points(root / "points.ply", POINTS, COLORS.astype(np.uint8))
        values["ply_file_path"] = "points.ply"
    (root / "transforms.json").write_text(json.dumps({**LENS, **values, "frames": frames}))
    return root


def write_floats(path, pixels, kind="half"):
    write_image(path, pixels.astype(np.float32), kind=kind)
