"""Turn images into meshes, each with a turntable animation and a strip of views.

Examples:
  python tools/reconstruct.py photo.png --run runs/airplane --output meshes    (transparent background)
  python tools/reconstruct.py photo.jpg --masks mask.png --run runs/airplane --output meshes
  python tools/reconstruct.py --dataset DATA --indices 0 31 62 --run runs/airplane --output meshes
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from learn3d.files.writing import check_target_folder
from learn3d.reconstruction import reconstruct_dataset, reconstruct_files
from learn3d.terminal import in_a_sentence, say


@dataclass(frozen=True)
class Command:
    """Turn images into meshes, each with a turntable animation and a strip of views."""

    run: Path
    """Run folder (or checkpoint file) of the trained model."""
    output: Path
    """Folder for the results: per image a mesh, a turntable GIF and a PNG strip."""
    images: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Images of any size, with a transparent background (or with --masks)."""
    masks: tuple[Path, ...] = ()
    """Mask images (white = object), one per image, for images without transparency."""
    dataset: Path | None = None
    """Take the images from this data set folder instead."""
    category: str | None = None
    """Class in the data set. None: the one the model was trained on."""
    split: Literal["train", "val", "test"] = "test"
    """Part of the data set."""
    indices: tuple[int, ...] = (0,)
    """Which images of the data set: object * V + view, of V views of each object (Kato's: 24, Kar's: 20)."""
    format: Literal["obj", "glb", "ply"] = "obj"
    """Format of the mesh files."""
    checkpoint: Literal["last", "best"] = "last"
    """Which networks of a run folder."""
    crop: bool = True
    """Centre and scale the object as in the data set; --no-crop for images that are framed so already."""
    frames: int = 36
    """Pictures of the turntable."""
    image_size: int = 256
    """Side of the turntable in pixels."""


@in_a_sentence()
def main() -> int:
    command = tyro.cli(Command, description=__doc__)
    options = {"mesh_format": command.format, "frames": command.frames, "image_size": command.image_size}
    if bool(command.images) == (command.dataset is not None):
        raise ValueError("give either image files or --dataset with --indices")
    check_target_folder(command.output, "--output")
    if command.dataset is not None:
        paths = reconstruct_dataset(
            command.run,
            command.output,
            command.dataset,
            command.indices,
            category=command.category,
            split=command.split,
            which=command.checkpoint,
            **options,
        )
    else:
        paths = reconstruct_files(
            command.run,
            command.output,
            command.images,
            command.masks,
            crop=command.crop,
            which=command.checkpoint,
            **options,
        )
    for path in paths:
        say(str(path))
    return 0


if __name__ == "__main__":
    sys.exit(main())
