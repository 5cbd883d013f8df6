"""MuJoCo Warp, a simulator in Warp, whose camera traces rays through Gaussians without harmonics."""

import mujoco
import mujoco_warp as simulator
import numpy as np
import warp as wp

from audit_targets.newton import pose_of
from warp_splat.formats.stored import SH_C0

MODEL = """<mujoco><worldbody><geom type="sphere" size="1e-3" pos="{hidden}"/>
<camera pos="{pos}" quat="{quat}" resolution="{w} {h}" sensorsize="{w} {h}" focal="{fx} {fy}" principal="{px} {py}"/>
</worldbody></mujoco>"""  # without a geom, version 4.0.0 ends with a segmentation fault


def draw(means, quats, scales, opacities, sh, camera, background):
    """MuJoCo Warp's ``render``, whose splats have colors and no harmonics."""

    def text(numbers) -> str:
        return " ".join(f"{number:.17g}" for number in numbers)

    places = {
        "pos": text(camera.center),
        "quat": text(np.roll(pose_of(camera), 1)),
        "w": camera.width,
        "h": camera.height,
    }
    places |= {"px": camera.width / 2 - camera.cx, "py": camera.height / 2 - camera.cy}
    places |= {"fx": camera.fx, "fy": camera.fy, "hidden": text(camera.center - 100 * camera.rotation[2])}
    model = mujoco.MjModel.from_xml_string(MODEL.format(**places))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    colors = (sh[:, 0].double() * SH_C0 + 0.5).clamp_min(0).detach().numpy()
    rgba = np.concatenate([colors, opacities.detach().numpy()[:, None]], 1)
    quats = quats / quats.norm(dim=1, keepdim=True)
    names = ("splat_position", "splat_rotation", "splat_scale", "splat_rgba")
    arrays = (np.float32(array) for array in (means.detach(), quats.detach(), scales.detach(), rgba))
    with wp.ScopedDevice("cpu"):
        settings = {"render_rgb": True, "cam_res": (camera.width, camera.height), "use_textures": False}
        settings |= {"background_color": (*background.tolist(), 1.0)}
        context = simulator.create_render_context(model, **settings, **dict(zip(names, arrays, strict=True)))
        simulator.render(simulator.put_model(model), simulator.put_data(model, data), context)
        out = wp.zeros((1, camera.height, camera.width), dtype=wp.vec3)
        simulator.get_rgb(context, 0, out)
        return np.round(out.numpy()[0] * 255).astype(np.uint8)
