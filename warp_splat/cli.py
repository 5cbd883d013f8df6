"""The command line: flags from the fields of the configurations, errors as one sentence."""

import argparse
import atexit
import difflib
import io
import os
import pkgutil
import re
import signal
import sys
from typing import Any

from warp_splat import __version__, config
from warp_splat.errors import InputError, tell
from warp_splat.flags import FOREIGN_FLAGS, check_numbers, default_of, flags_of, purpose_of
from warp_splat.presets import EMBEDDED_DEFAULTS, PRESETS
from warp_splat.runtime.interrupts import ending_as_by_ctrl_c, leaving_at_once
from warp_splat.text import upward
from warp_splat.training.options import FIXED_BY_PARTS, FIXED_OPTIONS, TrainConfig, check_train
from warp_splat.training.parts import AUTO, PARTS

#: Of each command: its options, whose docstring says what it does, and its function, loaded when it runs: torch takes
#: seconds.
COMMANDS = {
    "sfm": (config.SfmConfig, "sfm.command:sfm"),
    "inspect": (config.InspectConfig, "inspect.command:inspect"),
    "train": (TrainConfig, "training.command:train"),
    "render": (config.RenderConfig, "rendering.command:render_model"),
    "view": (config.ViewConfig, "viewer.command:view_model"),
    "convert": (config.ConvertConfig, "rendering.changes:convert"),
    "merge": (config.MergeConfig, "scene.blocks:merge_blocks"),
    "simplify": (config.SimplifyConfig, "pruning.simplify:simplify"),
    "clean": (config.CleanConfig, "pruning.clean:clean"),
    "mesh": (config.MeshConfig, "meshing.command:mesh"),
    "export-html": (config.ExportHtmlConfig, "export_html.command:export_html"),
    "audit": (config.AuditConfig, "audit.command:audit"),
    "compare": (config.CompareConfig, "compare.command:run"),
}

#: Flags whose default, none, is not meant by who gives them an empty text.
FILLED = "source_path model_path start_checkpoint start_ply config lpips_weights verify video_output out output".split()
UNUSUAL = re.compile(r"-(inf|[\d.]+e[-+]?\d+)", re.IGNORECASE)  # numbers that argparse takes for flags, without a space


def add_flags(parser: argparse.ArgumentParser, config_type: type) -> None:
    """A flag for each field of the configuration, with its default and help, under the heading of its group."""
    groups = {"": parser}  # the few that matter first stand beside --help
    for item in flags_of(config_type):
        title, default = item.metadata["group"], default_of(item)
        if title is None:
            parser.add_argument(item.name, metavar=item.name.upper(), help=item.metadata["help"])
            continue
        shown = " ".join(map(str, default)) if isinstance(default, list) else default
        note = "" if default in ("", [], False) else f" (default: {shown})"
        options: dict = {"default": argparse.SUPPRESS, "help": item.metadata["help"].replace("%", "%%") + note}
        if isinstance(default, bool):
            options["action"] = argparse.BooleanOptionalAction
        else:
            many, choices = item.metadata["many"], item.metadata["choices"]
            kind = many or type(default)
            named = ",".join(str(choice) for choice in choices or () if choice != "")
            metavar = f"{{{named}}}" if choices else kind.__name__.upper()
            options |= {"type": kind, "choices": choices, "metavar": metavar, "nargs": "*" if many else None}
        groups[title] = groups.get(title) or parser.add_argument_group(title)
        groups[title].add_argument(*item.metadata["names"], f"--{item.name}", dest=item.name, **options)


def make_parser() -> argparse.ArgumentParser:
    """The parser of ``warp-splat``."""
    parser = argparse.ArgumentParser(
        prog="warp-splat", description="3D Gaussian Splatting in NVIDIA Warp: photographs in, splats and new views out."
    )
    parser.add_argument("--version", action="version", version=f"warp-splat {__version__}")
    commands = parser.add_subparsers(dest="command", required=True)
    for name, (config_type, _) in COMMANDS.items():
        purpose = purpose_of(config_type)
        places = [item.name.upper() for item in flags_of(config_type) if item.metadata["group"] is None]
        usage = " ".join(["warp-splat", name, *places, "[options]"])  # not all flags before the first line of help
        said = purpose[:1].lower() + purpose[1:-1]  # in the list of commands
        add_flags(commands.add_parser(name, help=said, description=purpose, usage=usage), config_type)
    return parser


def parse(arguments: list[str]) -> Any:
    """The configuration that the arguments ask for, of a type of COMMANDS.

    Raises:
        InputError: for a flag that does not exist here, or that cannot change when a training is continued; for a
            number out of its bounds; for a configuration file that is not one.
    """
    for argument in arguments:
        if (name := argument.split("=")[0]) in FOREIGN_FLAGS:
            raise InputError(f"{name}: {FOREIGN_FLAGS[name]}; leave this flag out.")
    spaced = [f" {word}" if UNUSUAL.fullmatch(word) else word for word in arguments]
    known, unknown = make_parser().parse_known_args(spaced)
    config_type = COMMANDS[known.command][0]
    if unknown:
        flags = [f"--{item.name}" for item in flags_of(config_type) if item.metadata["group"] is not None]
        near = difflib.get_close_matches(unknown[0].split("=")[0], flags, 1)
        hint = f"did you mean {near[0]}?" if near else f"warp-splat {known.command} --help lists the flags."
        what = "no such flag" if re.match("-[^0-9]", unknown[0]) else "an argument too many"
        raise InputError(f"{unknown[0]}: {what}; {hint}")
    values = {name: value for name, value in vars(known).items() if name != "command"}
    for name in FILLED:
        if values.get(name) == "":  # mostly a variable of a shell that was never set
            what = "a hash" if name == "verify" else "a path"
            raise InputError(f"--{name}: expected {what}, got an empty one; leave the flag out or name one.")
    if values.get("crop") == []:
        raise InputError("--crop: expected six numbers, got none; leave the flag out or name a box.")
    if config_type is not TrainConfig:
        options = config_type(**values)
        check_numbers(options)
        return options
    if os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0":
        values = _restarted(values)
    given = values
    if values.get("config"):
        from warp_splat.training.config_file import read_config  # noqa: PLC0415 - seldom needed

        if (file := read_config(values["config"])).get("minutes"):
            _check_minutes(file)
            _check_minutes(given if "iterations" in given else {"minutes": file["minutes"], **given})
        values = _over(file, values)
    if values.get("start_checkpoint"):
        values = _continued(values)
    _check_parts(values.get("parts", ""), given)
    _check_minutes(given)
    if not values.get("start_checkpoint"):
        preset = values.get("preset", "fast" if values.get("minutes") else "")
        embedded = {"": {}, preset: {}} if "source_path" in values else EMBEDDED_DEFAULTS
        values = {**embedded[""], **PRESETS[preset], **embedded[preset], **values, "preset": preset}
    options = TrainConfig(**values)
    check_train(options)
    return options


def _restarted(given: dict) -> dict:
    """Words of a process that torchrun starts, maybe again: then it goes on from its own last checkpoint."""
    import psutil  # noqa: PLC0415 - seldom needed

    from warp_splat.formats.checkpoint import LAST  # noqa: PLC0415

    if not (given.get("model_path") or given.get("start_checkpoint")):
        raise InputError("-m: expected a folder, from which torchrun's --max-restarts could go on; name one.")
    folder, begun = given.get("model_path", ""), psutil.Process(os.getppid()).create_time()  # of torchrun
    path = os.path.join(folder, LAST)
    again = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") != "0"
    own = again and folder and os.path.isfile(path) and os.path.getmtime(path) > begun  # not of an older training
    of_this_run = {name: given[name] for name in ("verify", "viewer", "port") if name in given}
    return {"start_checkpoint": folder, **of_this_run} if own else given


def _continued(given: dict) -> dict:
    """Options of the checkpoint to start from, but for those that are given."""
    from warp_splat.formats.checkpoint import load_header  # noqa: PLC0415 - NumPy takes its time to load
    from warp_splat.training.config_file import load_options  # noqa: PLC0415 - as that does

    source = given["start_checkpoint"]
    options = load_options(source)
    for name, reason in FIXED_OPTIONS.items():
        if name in FIXED_BY_PARTS and not (options[name] and FIXED_BY_PARTS[name] in options["parts"].split(",")):
            continue
        if given.get(name, (kept := options[name])) != kept and os.path.abspath(str(given[name])) != kept:
            kept = "none" if kept == "" else kept
            raise InputError(f"--{name} {given[name]}: expected {kept}, as in {source} ({reason}); leave it out.")
    if given.get("minutes") and not options["minutes"]:
        raise InputError(
            f"--minutes: expected a training that began with it and does not end yet, found {source}; name a later end "
            "with --iterations."
        )
    if (minutes := given.get("minutes")) and (spent := load_header(source).fact("spent", float)) >= 60 * minutes:
        raise InputError(f"--minutes {minutes:g}: expected more than the {upward(spent / 60)} that {source} has taken.")
    return _over(options, given)


def _over(kept: dict, given: dict) -> dict:
    """Options of a file, and over them those that are given; ``--no-NAME`` of a part takes it out of the file's."""
    used = [name for name in kept.get("parts", "").split(",") if given.get(name) is not False]
    ended = {"minutes": 0.0, "settle_from_iter": 0} if "iterations" in given else {}
    return {**kept, **ended, "parts": ",".join(used), **given}


def _check_parts(parts: str, given: dict) -> None:
    """Raise InputError if a flag takes out a part that ``--parts`` puts in, or if one is named twice."""
    named = parts.split(",")
    for name in PARTS:
        if given.get(name) is False and (name in named or AUTO in named):
            hint = "name the parts to use" if AUTO in named else "leave one of them out"
            raise InputError(f"--no-{name}: expected no other word on this part, got --parts {parts}; {hint}.")
        if named.count(name) > 1:
            raise InputError(f"--parts {parts}: expected each part once, got {name} twice; leave one out.")


def _check_minutes(given: dict) -> None:
    """Raise InputError if the time given is none, or steps are given that it decides about."""
    minutes = given.get("minutes", 0.0)
    if "minutes" in given and not minutes > 0:
        raise InputError(f"--minutes: expected more than 0, got {minutes:g}; leave it out to train by --iterations.")
    steps = [item.name for item in flags_of(TrainConfig) if item.metadata["schedule"] and item.name in given]
    if minutes and steps:
        raise InputError(f"--minutes: expected no --{steps[0]} beside it, since it plans the steps; leave one out.")


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, 1 for bad input, 130 for an interruption."""
    # Python has none for those that are closed
    sys.stdout, sys.stderr = (stream or open(os.devnull, "w") for stream in (sys.stdout, sys.stderr))
    alike = os.environ.get("LOCAL_RANK", "0") != "0"  # what another process of this machine says as well
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":  # a name that it lacks ends nothing
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        options = parse(sys.argv[1:] if arguments is None else arguments)
        if isinstance(options, TrainConfig) and options.machine.portable:
            os.environ["WARP_SPLAT_PORTABLE"] = "1"  # read when kernels are loaded
        # idle OpenMP threads of torch must not spin beside busy kernels; read when torch is loaded
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        os.environ.setdefault("GOMP_SPINCOUNT", "0")
        # torch's profiler, by which the comparison measures memory, would tell what it does
        os.environ.setdefault("KINETO_LOG_LEVEL", "99")
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
        with leaving_at_once():
            place = next(place for kind, place in COMMANDS.values() if isinstance(options, kind))
            run = pkgutil.resolve_name(f"warp_splat.{place}")
        alike = False
        with ending_as_by_ctrl_c():
            return run(options)
    except (InputError, OSError) as error:
        if not alike:
            tell(error)
        return 1
    except KeyboardInterrupt:
        print("warp-splat: interrupted; what was saved before stays.", file=sys.stderr)
        return 130
    finally:
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)  # in what ends libraries, it would be a traceback
