"""Make the embedded scene again with known faults, each from a seed, and write down what they are.

    python assets/make_faults.py exposure vignetting --out output/faulty [--seed 0]

Of every eighth photograph by name, which `--eval` holds out, no pixel and no pose is changed: they are the truth to
measure with. Their camera is that of the others, and so its focal length; and a sky is over all. `truth.json` holds
what was done.
"""

import argparse
import json
import pathlib
import shutil

import numpy as np
import OpenImageIO as oiio
import pycolmap

from warp_splat.color import from_srgb, to_srgb
from warp_splat.scene import HOLD_OUT
from warp_splat.scene.images import read_pixels

SOURCE = pathlib.Path(__file__).parent / "still_life"
STOPS, TINT = 0.3, 0.1  # standard deviations over the photographs: of exposure, and of red and blue against green
SHUTTER, APERTURE, SPEED = 1 / 60, 4.0, 200  # of a photograph that nothing was done to
FALLOFF = 0.35  # of light in the corners
ANGLE, SHIFT = 0.5, 0.01  # root mean squares: of a turn [degrees], of a place, as a share of the cameras' extent
FOCAL = 0.01  # of the focal lengths
ROOM = (4.7, 3.3)  # half of its width, and its height: what is farther gives way to the sky
RAYS = 2  # RAYS x RAYS of a pixel
ZENITH, HAZE, GROUND = np.array([(0.10, 0.22, 0.55), (0.70, 0.72, 0.75), (0.22, 0.20, 0.17)])  # light of the sky
SUN, GLOW = np.array([0.48, 0.36, 0.8]), np.array([0.9, 0.7, 0.4])  # where it stands, and its light
CORNER = np.array((-4.8, 4.8, 0.0))  # where two walls meet


class Fault:
    """Numbers of one fault, by the names of the photographs that train; ``random`` is its own."""

    def __init__(self, names: list[str], seed: int, place: int):
        self.names, self.random = names, np.random.default_rng([seed, place])

    def normal(self, scale: float, width: int) -> np.ndarray:
        """Normal numbers [V, width] without a mean: what all photographs share would be no fault."""
        numbers = self.random.normal(scale=scale, size=(len(self.names), width))
        return numbers - numbers.mean(0)


def exposure(fault: Fault, images: dict, model) -> dict:
    """Gains of light and white balance for each photograph; EXIF says the gains of two of three."""
    stops = fault.normal(STOPS, 1) + fault.normal(TINT, 3) * (1, 0, 1)
    for name, change in zip(fault.names, stops, strict=True):
        images[name] = images[name] * 2**change
    return {name: change.tolist() for name, change in zip(fault.names, stops, strict=True)}


def vignetting(fault: Fault, images: dict, model) -> float:
    """Light falls with the square of the distance to the middle."""
    for name in fault.names:
        height, width, _ = images[name].shape
        y, x = (np.arange(size) + 0.5 - 0.5 * size for size in (height, width))
        square = ((y * y)[:, None] + x * x) / (0.25 * (height**2 + width**2))
        images[name] = images[name] * (1 - FALLOFF * square)[..., None]
    return FALLOFF


def pose(fault: Fault, images: dict, model) -> dict:
    """Cameras are turned and moved in the model, each about itself."""
    found = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    places = np.array([found[name].projection_center() for name in fault.names])
    extent = 1.1 * np.linalg.norm(places - places.mean(0), axis=1).max()
    turns = fault.normal(np.radians(ANGLE) / 3**0.5, 3)
    shifts = fault.normal(SHIFT * extent / 3**0.5, 3)
    for name, place, turn, shift in zip(fault.names, places, turns, shifts, strict=True):
        rotation = pycolmap.Rotation3d(turn) * found[name].cam_from_world().rotation
        translation = -rotation.matrix() @ (place + shift)
        found[name].frame.rig_from_world = pycolmap.Rigid3d(rotation, translation)
    rows = zip(fault.names, turns.tolist(), shifts.tolist(), strict=True)
    return {name: {"turn": turn, "shift": shift} for name, turn, shift in rows}


def focal(fault: Fault, images: dict, model) -> float:
    """The model's focal lengths are too long."""
    for camera in model.cameras.values():
        camera.params = [*(1 + FOCAL) * np.array(camera.params[:2]), *camera.params[2:]]
    return 1 + FOCAL


def corner(fault: Fault, images: dict, model) -> list[str]:
    """Of the photographs that see a corner of the room all but two are left out: their masks are black."""
    seeing = []
    for image in [model.image(i) for i in model.reg_image_ids()]:
        place = image.project_point(CORNER)
        if image.name in fault.names and place is not None and (0 <= place).all():
            if (place < (image.camera.width, image.camera.height)).all():
                seeing.append(image.name)
    return sorted(fault.random.permutation(sorted(seeing))[2:].tolist())


def sky(fault: Fault, images: dict, model) -> dict:
    """A sky in the place of the walls and the ceiling, whose points are left out; of every photograph."""
    from scene_geometry import still_life  # noqa: PLC0415 - traced for this fault alone
    from scene_trace import Measure  # noqa: PLC0415

    distances = Measure(still_life())
    for image in [model.image(i) for i in model.reg_image_ids()]:
        height, width, _ = images[image.name].shape
        pose, offsets = image.cam_from_world(), (np.arange(RAYS) + 0.5) / RAYS
        y, x = (np.add.outer(np.arange(size), offsets) for size in (height, width))
        pixels = np.stack(np.broadcast_arrays(x, y[:, :, None, None]), -1).reshape(-1, 2)
        rays = np.column_stack([image.camera.cam_from_img(pixels), np.ones(len(pixels))])
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ pose.rotation.matrix()
        origins = np.broadcast_to(image.projection_center(), rays.shape)
        hits = origins + distances(origins, rays)[:, None] * rays
        light = np.where(beyond(hits)[:, None], sky_light(rays), np.nan).reshape(height, RAYS, width, RAYS, 3)
        share = np.isfinite(light).mean((1, 3))
        images[image.name] = (1 - share) * images[image.name] + np.nansum(light, (1, 3)) / RAYS**2
    for i in [i for i, point in model.points3D.items() if beyond(point.xyz[None])[0]]:
        model.delete_point3D(i)
    return {"room": ROOM}


def beyond(points: np.ndarray) -> np.ndarray:
    """Which of points [P, 3] are not in the room."""
    return (np.abs(points[:, :2]).max(1) > ROOM[0]) | (points[:, 2] > ROOM[1])


def sky_light(rays: np.ndarray) -> np.ndarray:
    """Linear light of the sky along unit rays [P, 3]: haze at the horizon, the ground below it, a glow of the sun."""
    up = rays[:, 2:]
    light = HAZE + (np.where(up > 0, ZENITH, GROUND) - HAZE) * np.abs(up) ** 0.7
    return light + GLOW * np.exp(6 * (rays @ (SUN / np.linalg.norm(SUN)) - 1))[:, None]


FAULTS = {make.__name__: make for make in (exposure, vignetting, pose, focal, corner, sky)}


def make_faulty(out: pathlib.Path, faults: list[str], seed: int = 0) -> dict:
    """Write the embedded scene with these faults into a new folder; the truth, by fault."""
    model = pycolmap.Reconstruction(SOURCE / "sparse" / "0")
    names = sorted(model.image(i).name for i in model.reg_image_ids())
    training = [name for index, name in enumerate(names) if index % HOLD_OUT]
    changed = names if "sky" in faults else training
    images = {name: from_srgb(read_pixels(SOURCE / "images" / name, 0.0).color, np.where) for name in changed}
    truth = {
        name: make(Fault(training, seed, place), images, model)
        for place, (name, make) in enumerate(FAULTS.items())
        if name in faults
    }
    (out / "images").mkdir(parents=True)
    (out / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(out / "sparse" / "0"))
    for name in truth.get("corner", []):  # left out of the model, they would change which ones are held out
        (out / "masks").mkdir(exist_ok=True)
        write_photograph(out / "masks" / name, np.zeros_like(images[name]), None)
    changes = truth.get("exposure", {})
    for index, name in enumerate(names):
        if name in images:
            green = changes[name][1] if name in changes and index % 3 else None
            write_photograph(out / "images" / name, to_srgb(images[name], np.where), green)
        else:
            shutil.copy(SOURCE / "images" / name, out / "images" / name)
    (out / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return truth


def write_photograph(path: pathlib.Path, image: np.ndarray, stops: float | None) -> None:
    """Write [H, W, 3] of 0 to 1 as 8-bit PNG, with an exposure time that is longer by so many stops."""
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], 3, "uint8")
    if stops is not None:
        settings = {"ExposureTime": SHUTTER * 2**stops, "FNumber": APERTURE, "Exif:PhotographicSensitivity": SPEED}
        for name, value in settings.items():
            spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    pixels = np.rint(255 * image.clip(0, 1)).astype(np.uint8)
    if not (output and output.open(str(path), spec) and output.write_image(pixels) and output.close()):
        raise OSError(f"cannot write {path}: {oiio.geterror()}")


def main() -> None:
    """Make the scene that was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("faults", nargs="+", choices=FAULTS)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if (arguments.out / "images").exists():
        parser.error(f"--out {arguments.out}: expected a new folder, found a scene; name another.")
    make_faulty(arguments.out, arguments.faults, arguments.seed)
    print(f"{arguments.out}: train on it by `uv run train.py -s {arguments.out} --eval`; truth.json has the faults")


if __name__ == "__main__":
    main()
