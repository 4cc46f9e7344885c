"""Train a model that turns one image into a 3D shape.

Examples:
  learn3d train --data DATA --category airplane --output runs/airplane
  learn3d train --data DATA --category airplane,car --preset vanilla --output runs/vanilla
  learn3d train --resume --output runs/airplane
  torchrun --nproc-per-node 2 -m learn3d train --data DATA --category airplane --output runs/airplane
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from learn3d.commands.parsing import parse
from learn3d.config import DEFAULT_PRESET, TrainConfig, load_config
from learn3d.distributed.launch import init_process_group, rank_label
from learn3d.distributed.process_group import LostPeerError
from learn3d.presets import METHODS, PRESETS, full_name
from learn3d.terminal import INTERRUPTED, say, without_traceback
from learn3d.training import train

COMMON = ("data", "category", "output", "preset", "layout", "iterations", "batch_size", "seed", "device", "threads")
COMMON += ("validate_every", "resume", "overwrite")


@dataclass(frozen=True, kw_only=True)
class Command:
    """What is asked for."""

    config: tyro.conf.OmitArgPrefixes[tyro.conf.AvoidSubcommands[TrainConfig]]
    resume: bool = False
    """Continue the run in --output; its saved options apply unless given again."""
    overwrite: bool = False
    """Replace an earlier run in --output."""


def read(arguments: Sequence[str]) -> Command:
    """Parse; the preset, or with --resume the saved run, decides which settings there are and their values."""
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--preset")
    chosen, arguments = finder.parse_known_args(arguments)
    finder.add_argument("--resume", action="store_true")
    finder.add_argument("--output", type=Path)
    known, others = finder.parse_known_args(arguments)
    preset = None if chosen.preset is None else full_name(chosen.preset)
    if known.resume and not {"-h", "--help", "--help-all"} & set(others):
        if known.output is None:
            raise ValueError("--resume needs --output: the folder of the run that is to go on")
        default = load_config(known.output / "config.json")
        if preset not in (None, default.preset):
            raise ValueError(f"{known.output} was started with the preset {default.preset}, got {preset}")
    else:
        default = _options_of(preset or DEFAULT_PRESET)
    about = {"name": "train", "about": f"{__doc__}\n{_methods()}", "more": _presets(), "common": COMMON}
    return parse(Command, arguments, **about, default=Command(config=default))


def _options_of(name: str) -> TrainConfig:
    """The options of a preset; those that every run must give are missing, which only tyro understands."""
    preset, options = PRESETS[name], object.__new__(TrainConfig)
    for field in dataclasses.fields(TrainConfig):
        value = tyro.MISSING if field.default is dataclasses.MISSING else field.default
        object.__setattr__(options, field.name, getattr(preset, field.name, value))
    object.__setattr__(options, "preset", name)
    object.__setattr__(options, "warmup_steps", None)  # the preset's, but at most a tenth of the run
    return options


def _methods() -> str:
    return f"Methods (--preset): {', '.join(METHODS)}; --help-all has the presets for other data sets."


def _presets() -> str:
    short = {name: f" ({method})" for method, name in METHODS.items()}
    lines = [f"  {name}{short.get(name, '')}: {preset.label}; {preset.source}" for name, preset in PRESETS.items()]
    return "\n".join(["Presets (--preset NAME --help-all shows the settings of one):", *lines])


@without_traceback(FloatingPointError, MemoryError, LostPeerError, label=rank_label)
def run(arguments: Sequence[str]) -> int:
    """Train, and say how it ended; the exit status is 130 where a signal stopped the only process."""
    command = read(arguments)
    if command.resume and command.overwrite:
        raise ValueError("--resume continues a run and --overwrite replaces it; give one of them")
    with init_process_group(command.config.device) as group:  # the first Ctrl-C in it saves
        summary = train(command.config, resume=command.resume, overwrite=command.overwrite, group=group)
    if group.is_main:
        say(str(summary))
    return 0 if summary.finished or group.world_size > 1 else INTERRUPTED  # torchrun would take it for a failure
