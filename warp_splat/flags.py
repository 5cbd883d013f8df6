"""Command-line flags as fields of dataclasses, under the headings of ``--help``. Standard library only."""

import math
from dataclasses import MISSING, Field, field, fields
from functools import partial
from typing import Any

from warp_splat.errors import InputError


def flag(default: Any, help: str, *names: str, **metadata: Any) -> Any:
    """A dataclass field that is also a command-line flag: its default, its help, further names.

    ``metadata`` may have ``choices``, a tuple; ``many``, the type of a list's elements; ``least`` and ``most``, bounds
    of a number if those are not 0 and none; ``schedule``: a step of the schedule, which ``--minutes`` plans. Without a
    ``group`` it is one of the few that ``--help`` lists first.
    """
    usual = {"choices": None, "many": None, "group": "", "least": 0, "most": math.inf, "schedule": False}
    metadata = {"help": help, "names": names, **usual, **metadata}
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def argument(help: str) -> Any:
    """A dataclass field that is also an argument of the command line without a flag: known by its place."""
    return flag("", help, group=None)


data = partial(flag, group="what is read")
rendering = partial(flag, group="how Gaussians are rendered")
learning = partial(flag, group="how they learn")
growing = partial(flag, group="how many they become")
reporting = partial(flag, group="what is kept and told")
film = partial(flag, group="frames of a video")
LAST = "where it is computed"
machinery = partial(flag, group=LAST)


def flags_of(config_type: Any) -> list[Field]:
    """The flags of a configuration, or of its groups, heading by heading."""
    groups = config_type.groups() if hasattr(config_type, "groups") else [config_type]
    found = [item for group in groups for item in fields(group)]
    headings = list(dict.fromkeys([None, "", *(item.metadata["group"] for item in found)]))
    return sorted(found, key=lambda item: (item.metadata["group"] == LAST, headings.index(item.metadata["group"])))


def purpose_of(config_type: type) -> str:
    """What the command with these options does, as ``--help`` says it: the first sentence of their docstring."""
    return (config_type.__doc__ or "").split("\n", 1)[0]  # none with python -OO


def default_of(item: Field) -> Any:
    """The default of a flag."""
    return item.default if item.default_factory is MISSING else item.default_factory()


def check_numbers(config: Any) -> None:
    """Raise InputError if a number of ``config`` is out of its bounds."""
    values = config.flat() if hasattr(config, "flat") else vars(config)
    for item in flags_of(type(config)):
        value, least, most = values[item.name], item.metadata["least"], item.metadata["most"]  # True is 1
        if isinstance(value, list) and item.metadata["many"] is int and min(value, default=1) < 1:
            raise InputError(f"--{item.name}: expected numbers of steps, at least 1, got {min(value)}.")
        if isinstance(value, int | float) and not (least <= value <= most and value < math.inf):
            bounds = f"{least} to {most}" if most < math.inf else f"at least {least}"
            finite = "a finite number, " * isinstance(value, float)
            raise InputError(f"--{item.name}: expected {finite}{bounds}, got {value}.")


def fits(value: Any, item: Field) -> bool:
    """Whether ``value``, read from a file, can be that of the option with this field."""
    return _is_like(value, default_of(item)) and (not item.metadata["choices"] or value in item.metadata["choices"])


def _is_like(value: Any, default: Any) -> bool:
    if isinstance(default, list):
        return type(value) is list and all(_is_like(item, 0) for item in value)
    if type(default) is float:
        return type(value) is float or _is_like(value, 0)
    fits_in = "\0" not in value if type(value) is str else type(value) is not int or abs(value) < 2**63
    return type(value) is type(default) and fits_in


#: Flags of the reference that this program does not have, and what to say when somebody uses one.
FOREIGN_FLAGS = {
    "--train_test_exp": "no exposure is learned of held-out photographs; CC_PSNR fits one for each",
    "--exposure_lr_delay_steps": "the rate of exposure falls from its start; there is no delay",
    "--exposure_lr_delay_mult": "the rate of exposure falls from its start; there is no delay",
    "--position_lr_delay_mult": "the delay of the means' rate has no effect in the reference and is left out",
    "--convert_SHs_python": "colors are always computed by the kernels",
    "--compute_cov3D_python": "covariances are always computed by the kernels",
    "--ip": "the viewer (--viewer) is served to this machine only",
    "--host": "the viewer is served to this machine only; from another, go through ssh -L",
    "--disable_viewer": "there is no viewer unless --viewer asks for it",
    "--debug": "there is no debug mode; set WARP_SPLAT_TRACEBACK=1 to see where an error arose",
    "--debug_from": "there is no debug mode; set WARP_SPLAT_TRACEBACK=1 to see where an error arose",
    "--detect_anomaly": "gradients that are not finite are always dropped and counted",
}
