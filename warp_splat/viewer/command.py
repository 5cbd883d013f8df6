"""``warp-splat view``: a model in a browser, until Ctrl-C."""

from dataclasses import replace

from warp_splat.config import ViewConfig
from warp_splat.errors import InputError
from warp_splat.gaussians import GaussianModel
from warp_splat.raster.selftest import settle_device
from warp_splat.rendering.finished import Finished
from warp_splat.runtime.interrupts import interruptible
from warp_splat.scene.types import Scene
from warp_splat.viewer.server import AS_GIVEN, Viewer, free_port


def view_model(config: ViewConfig) -> int:
    """Serve the model that ``config`` names until Ctrl-C; returns the process's exit code.

    Raises:
        InputError: if the model, the scene or the port is not usable.
    """
    if not config.model:
        raise InputError("MODEL: expected the folder of a trained model, or a file of Gaussians; name one.")
    free_port(config.port)  # before the scene is loaded
    device = settle_device(config.device, config.threads)
    finished = Finished(config.model, config.iteration, config.crop)
    model = GaussianModel.from_splats(finished.file.splats).arranged().to(device)
    print(f"{len(model)} Gaussians from {config.model}, iteration {finished.iteration}")
    scene = _find_scene(finished, config.source_path)
    options = replace(finished.options, of="trained", tolerance=config.tolerance or None)
    print("Preparing kernels (compiled once on a machine, about 20 s) ...")
    draw, linear = finished.renderer(model, options), finished.is_linear(scene)
    exposures = lambda: finished.exposures  # noqa: E731
    with Viewer(draw, model, scene, config.port, linear, exposures) as viewer, interruptible() as interrupted:
        print(f"{viewer.announcement}; Ctrl-C ends it", flush=True)
        while not interrupted:
            if not viewer.draw():
                viewer.wait()
    return 0


def _find_scene(finished: Finished, source_path: str) -> Scene | None:
    """The scene of the model; None if it is not known or has gone, since one can look around without it.

    Where cameras were refined, each photograph is there twice: seen by its camera as it is now, and as it was given.
    """
    try:
        given = finished.load_scene(source_path, print)
        if (scene := finished.refined(given)) is given:
            return scene
        views = [replace(view, name=f"{view.name}{AS_GIVEN}") for view in (*given.train, *given.test)]
        return replace(scene, test=[*scene.test, *views])
    except InputError as error:
        if source_path:
            raise
        print(f"Without photographs: {error}")
        return None
