"""Other defaults: of ``--preset``, and of training the embedded scene. Standard library only."""

from typing import Any

#: Rates of what is not the means, two and three times the reference's.
DOUBLED = {"feature_lr": 0.005, "opacity_lr": 0.05, "scaling_lr": 0.01, "rotation_lr": 0.002}
TRIPLED = {"feature_lr": 0.0075, "opacity_lr": 0.075, "scaling_lr": 0.015, "rotation_lr": 0.003}

#: What the embedded scene changes by preset when no ``-s`` is given: schedules that end within minutes on two cores.
EMBEDDED_DEFAULTS: dict[str, dict[str, Any]] = {
    "": {
        "eval": True,
        "iterations": 3000,
        "position_lr_max_steps": 3000,
        "densify_until_iter": 2000,
        "max_gaussians": 50_000,
        "sh_interval": 500,
    },
    "fast": {
        "iterations": 1700,
        "position_lr_max_steps": 1700,
        **TRIPLED,
        "cooldown": 0,
        "coarse_until_iter": 1150,
        "densify_from_iter": 200,
        "densify_until_iter": 1150,
        "max_gaussians": 50_000,
        "sh_interval": 400,
    },
}

#: What ``--preset`` changes; a flag that is given takes precedence. Tried:
#: - 1.3 to 1.7 x Adam's time where 65 to 100 % of the Gaussians are in view: sparse_adam
#: - 3.8 dB worse after 1,500 steps at half size: rates that decay to a tenth all along
#: - 0.8 dB better after these: doubled rates
#: - 31.3 dB after 4,500 steps at full size: doubled rates to the end; 31.5 dB after 3,600 if they fall over the last
#:   1,000
#: - 0.8 dB better on the embedded scene, 0.2 dB worse on photographs: threefold rates
PRESETS: dict[str, dict[str, Any]] = {
    "": {},
    "fast": {
        "iterations": 3600,
        "position_lr_max_steps": 9000,
        **DOUBLED,
        "cooldown": 1000,
        "coarse": 4,
        "coarse_until_iter": 2800,
        "coarse_by": "detail",
        "densify_from_iter": 300,
        "densify_until_iter": 2800,
        "growth": "budget",
        "max_gaussians": 100_000,
        "sh_interval": 1000,
        "opacity_reset_interval": 100_000,
    },
}
