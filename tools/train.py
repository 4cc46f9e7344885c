"""Train a model that turns one image into a 3D mesh.

Examples:
  python tools/train.py --data DATA --category airplane --output runs/airplane
  python tools/train.py --output runs/airplane --resume
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from learn3d.config import TrainConfig, load_config
from learn3d.training import train


@dataclass(frozen=True)
class Command:
    """Train a model that turns one image into a 3D mesh."""

    config: tyro.conf.OmitArgPrefixes[TrainConfig]
    resume: bool = False
    """Continue the run in --output; its saved options apply unless given again."""
    overwrite: bool = False
    """Replace an earlier run in --output."""


def parse(arguments: list[str]) -> Command:
    """Read the command line; with --resume the options saved in the run folder are the defaults."""
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--resume", action="store_true")
    finder.add_argument("--output", type=Path)
    known, _ = finder.parse_known_args(arguments)
    default = {}
    if known.resume and known.output is not None:
        default = {"default": Command(load_config(known.output / "config.json"))}
    return tyro.cli(Command, args=arguments, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,), **default)


def main() -> int:
    try:
        command = parse(sys.argv[1:])
        if command.resume and command.overwrite:
            raise ValueError("--resume continues a run and --overwrite replaces it; give one of them")
        summary = train(command.config, resume=command.resume, overwrite=command.overwrite)
    except (ValueError, OSError, FloatingPointError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    state = "finished" if summary.finished else "stopped"
    best = f"best validation voxel IoU {summary.best_iou:.4f} at step {summary.best_step}; "
    print(
        f"{state} at step {summary.step} after {summary.seconds / 60:.1f} min; "
        f"{best if summary.best_step else ''}everything is in {summary.folder}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
