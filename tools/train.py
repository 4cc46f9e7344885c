"""Train a model that turns one image into a 3D shape.

Examples:
  python tools/train.py --data DATA --category airplane --output runs/airplane
  python tools/train.py --preset peng2020-kato-vanilla --data DATA --category airplane --output runs/vanilla
  python tools/train.py --output runs/airplane --resume
  torchrun --nproc-per-node 2 tools/train.py --data DATA --category airplane --output runs/airplane
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from learn3d.config import DEFAULT_PRESET, TrainConfig, load_config
from learn3d.parallel.ranks import LostPeerError, label, start
from learn3d.presets import PRESETS
from learn3d.terminal import in_a_sentence, say
from learn3d.training import train


@dataclass(frozen=True)
class Command:
    """Train a model that turns one image into a 3D shape."""

    config: tyro.conf.OmitArgPrefixes[tyro.conf.AvoidSubcommands[TrainConfig]]
    resume: bool = False
    """Continue the run in --output; its saved options apply unless given again."""
    overwrite: bool = False
    """Replace an earlier run in --output."""


def parse(arguments: list[str]) -> Command:
    """Read the command line.

    The preset decides which settings there are and their defaults; with --resume the options saved in the run folder
    are the defaults.
    """
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--resume", action="store_true")
    finder.add_argument("--output", type=Path)
    finder.add_argument("--preset")
    known, others = finder.parse_known_args(arguments)
    if known.resume and known.output is None and not {"-h", "--help"} & set(others):
        raise ValueError("--resume needs --output: the folder of the run that is to go on")
    if known.resume and known.output is not None:
        default = load_config(known.output / "config.json")
        if known.preset not in (None, default.preset):
            raise ValueError(f"{known.output} was started with the preset {default.preset}, got {known.preset}")
    else:
        default = _options_of(known.preset or DEFAULT_PRESET)
    style = (tyro.conf.FlagCreatePairsOff,)
    return tyro.cli(Command, args=arguments, description=_description(), default=Command(default), config=style)


def _options_of(name: str) -> TrainConfig:
    """The options of a preset; those that every run must give are missing, which only tyro understands."""
    if name not in PRESETS:
        raise ValueError(f"there is no preset {name!r}; choose one of {', '.join(PRESETS)}")
    preset, options = PRESETS[name], object.__new__(TrainConfig)
    for field in dataclasses.fields(TrainConfig):
        value = tyro.MISSING if field.default is dataclasses.MISSING else field.default
        object.__setattr__(options, field.name, getattr(preset, field.name, value))
    object.__setattr__(options, "preset", name)
    return options


def _description() -> str:
    presets = "\n".join(f"  {name}: {preset.label}; {preset.source}" for name, preset in PRESETS.items())
    return f"{__doc__}\nPresets (--preset NAME --help shows the settings of one):\n{presets}"


@in_a_sentence(FloatingPointError, MemoryError, LostPeerError, label=label)
def main() -> int:
    command = parse(sys.argv[1:])
    if command.resume and command.overwrite:
        raise ValueError("--resume continues a run and --overwrite replaces it; give one of them")
    with start(command.config.device) as ranks:  # the first Ctrl-C in it saves and ends well
        summary = train(command.config, resume=command.resume, overwrite=command.overwrite, ranks=ranks)
    if not ranks.main:
        return 0
    say(str(summary))
    return 0


if __name__ == "__main__":
    sys.exit(main())
