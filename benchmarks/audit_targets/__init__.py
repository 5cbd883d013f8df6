"""Other people's renderers: an adapter is a file of this folder and a line of this table."""

from pathlib import Path

from warp_splat.audit.targets import NamedRenderer

FOLDER, WEBGL = Path(__file__).parent, "WebGL in software"
OTHERS = {
    "gsplat-torch": NamedRenderer(
        "audit_targets.gsplat_torch:reference", "gsplat", "_torch_impl.py; its loop over pixels by us"
    ),
    "newton": NamedRenderer("audit_targets.newton:newton", "newton", "SensorCamera as it is delivered", 0),
    "newton-blended": NamedRenderer(
        "audit_targets.newton:newton_blended", "newton", "QUALITY, min_response 1/255, transmittance 1", 0
    ),
    "mujoco-warp": NamedRenderer("audit_targets.mujoco:draw", "mujoco-warp", "a scene of splats alone", 0),
    "playcanvas": NamedRenderer(f"{FOLDER}/playcanvas.html", "playcanvas@2.23.3", WEBGL),
    "spark": NamedRenderer(f"{FOLDER}/spark.html", "spark@2.2.0", f"three.js 0.187.0, {WEBGL}"),
    "babylon": NamedRenderer(f"{FOLDER}/babylon.html", "babylonjs@9.35.0", WEBGL),
    "mkkellogg": NamedRenderer(f"{FOLDER}/mkkellogg.html", "gaussian-splats-3d@0.4.7", f"three.js 0.187.0, {WEBGL}", 2),
    "gsplat-js": NamedRenderer(f"{FOLDER}/gsplat_js.html", "gsplat@1.2.9", f"no fading in, {WEBGL}", 0),
}
