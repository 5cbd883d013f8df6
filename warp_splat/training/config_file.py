"""Training options in files: ``--config`` and checkpoints in, ``config.toml`` in the model folder out."""

import difflib
import json
import tomllib
from pathlib import Path
from typing import Any

from warp_splat.errors import InputError, refusing
from warp_splat.flags import default_of, fits, flags_of
from warp_splat.formats.checkpoint import EXPECTED, load_header
from warp_splat.formats.files import Unexpected, reading, write_text
from warp_splat.training.options import TrainConfig, check_train

NAME = "config.toml"
#: Where it wrote, came from and was seen, and what it was compared with.
OF_ONE_RUN = ("model_path", "start_checkpoint", "config", "viewer", "port", "verify")
KINDS = {str: "a text", bool: "true or false", int: "a whole number", float: "a number", list: "a list of numbers"}


def read_config(path: str | Path) -> dict[str, Any]:
    """The options in a file, by name; those that it leaves out keep their defaults.

    Raises:
        InputError: if it cannot be read or is no TOML; for an unknown option, or a value that it cannot have.
    """
    problem = f"--config {path}: expected a TOML file with options of training"
    with refusing((OSError, ValueError, RecursionError), problem), open(path, "rb") as file:
        found = tomllib.loads(file.read().decode("utf-8-sig"))
    options = {item.name: item for item in flags_of(TrainConfig) if item.name != "config"}
    for name, value in found.items():
        if name not in options:
            near = difflib.get_close_matches(name, options, 1)
            hint = f"did you mean {near[0]}?" if near else "warp-splat train --help lists them."
            raise InputError(f"--config {path}: {name}: no such option; {hint}")
        if not fits(value, (item := options[name])):
            choices = item.metadata["choices"]
            expected = f"one of {', '.join(map(repr, choices))}" if choices else KINDS[type(default_of(item))]
            raise InputError(f"--config {path}: {name}: expected {expected}, found {value!r:.60}; change it there.")
    return found


def load_options(path: str | Path) -> dict[str, Any]:
    """The options in a checkpoint, by name; those that an older program did not know have their defaults.

    Raises:
        InputError: as :func:`load_header`, or if an option is unknown or has an impossible value.
    """
    header, options = load_header(path), {item.name: item for item in flags_of(TrainConfig)}
    with reading(header.path, EXPECTED):
        if not isinstance((found := header.facts.get("options")), dict):
            raise Unexpected("one without options, as a block of one is; name the file that names the blocks")
        for name, value in found.items():
            if name not in options:
                raise Unexpected(f"an option that it does not have, {name!r:.50}")
            if not fits(value, options[name]):
                raise Unexpected(f"{value!r:.50} as its option {name}")
        config = TrainConfig(**found)
        try:
            check_train(config)
        except InputError as error:
            raise Unexpected(f"an impossible option ({str(error).rstrip('.')})") from error
    return config.flat()


def write_config(folder: str | Path, config: TrainConfig) -> None:
    """Write every option but those of this one run, under the headings of ``--help``, each with what it means.

    Raises:
        InputError: if the file cannot be written.
    """
    values = config.flat()
    lines, group = ["# The options of this training; train.py --config with this file repeats it."], ""
    for item in flags_of(TrainConfig):
        if item.name in OF_ONE_RUN:
            continue
        if item.metadata["group"] != group:
            group = item.metadata["group"]
            lines += ["", f"# {group}"]
        # a text of JSON is one of TOML, but for the one character that JSON does not escape
        value = json.dumps(values[item.name], ensure_ascii=False).replace("\x7f", "\\u007f")
        lines.append(f"{item.name} = {value}  # {item.metadata['help']}")
    write_text(Path(folder) / NAME, "\n".join([*lines, ""]))
