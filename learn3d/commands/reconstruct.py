"""Turn images into meshes, each with a turntable animation and a strip of views.

Examples:
  learn3d reconstruct photo.png --output meshes    (transparent background; the small model of the package)
  learn3d reconstruct photo.jpg --masks mask.png --run runs/airplane --output meshes
  learn3d reconstruct --data DATA --indices 0 31 62 --run runs/airplane --output meshes
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from learn3d.commands.parsing import parse
from learn3d.terminal import say


@dataclass(frozen=True)
class Command:
    """What is asked for."""

    output: Path
    """Folder for the results: of each image a mesh, a turntable GIF and a PNG strip."""
    run: Path | None = None
    """Run folder (or checkpoint file) of the trained model; without it, the small one that comes with the package."""
    images: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Images of any size, with a transparent background (or with --masks or --plain-background)."""
    masks: tuple[Path, ...] = ()
    """Mask images (white = object), one for each image, where the background is not transparent."""
    plain_background: bool = False
    """The background has one colour: what differs from that of the border is the object."""
    data: Path | None = None
    """Take the images from this data set instead."""
    category: str | None = None
    """Class in the data set, if not the one the model was trained on."""
    split: Literal["train", "val", "test"] = "test"
    """Part of the data set."""
    indices: tuple[int, ...] = (0,)
    """Which images of the data set: object * V + view, of V views of each object (Kato's: 24, Kar's: 20)."""
    format: Literal["glb", "obj", "ply"] = "glb"
    """Format of the mesh files."""
    checkpoint: Literal["last", "best"] = "last"
    """Which networks of a run: the last ones, or those with the best validation IoU."""
    crop: bool = True
    """Leave the images as they are. Without it the object is centred and scaled as in the data set."""
    refine: bool = False
    """Fit each shape to its mask afterwards, a few seconds for each image; the camera must be known: that of the data
    set, or --azimuths."""
    azimuths: tuple[float, ...] = ()
    """With --refine, where the camera of each image file stands, in degrees: one for each image. 0: in front of the
    object; 90: at the side that the front view shows on its right."""
    elevation: float = 30.0
    """Its height above the object's plane in degrees, the same for all image files."""
    frames: int = 36
    """Pictures of the turntable."""
    image_size: int = 256
    """Side of the turntable in pixels."""


_OF_IMAGES = ("masks", "plain_background", "crop", "azimuths", "elevation")


def run(arguments: Sequence[str]) -> int:
    """Reconstruct, and print the paths of the files."""
    command = parse(Command, arguments, name="reconstruct", about=__doc__)
    if bool(command.images) == (command.data is not None):
        raise ValueError("give either image files, or --data with --indices")
    if command.output.suffix.lower() in (".glb", ".obj", ".ply"):
        raise ValueError(f"--output is a folder, got {command.output}; the files in it are named after the images")
    others = ("category", "split", "indices") if command.images else _OF_IMAGES
    if ignored := [
        f"--{name.replace('_', '-')}" for name in others if getattr(command, name) != getattr(Command, name)
    ]:
        given, wanted = ("image files", "--data") if command.images else ("--data", "image files")
        raise ValueError(f"{given} given; leave out what belongs to {wanted}: {', '.join(ignored)}")
    if command.images and command.refine != bool(command.azimuths):
        raise ValueError("--refine takes the azimuth of the camera of each image file: give --refine --azimuths A ...")
    if command.images and not command.refine and command.elevation != Command.elevation:
        raise ValueError("--elevation is where the camera stood that --refine fits to: give --refine --azimuths A ...")
    import torch

    from learn3d.data.conventions import DISTANCE, HALF_FOV_DEG
    from learn3d.data.poses import LookAtPoses
    from learn3d.files.writing import check_target
    from learn3d.reconstruction import reconstruct_dataset, reconstruct_files

    check_target(command.output, "--output", folder=True)
    options = {"which": command.checkpoint, "mesh_format": command.format}
    options |= {"frames": command.frames, "image_size": command.image_size}
    where = (command.run, command.output)
    if command.data is not None:
        chosen = {"category": command.category, "split": command.split, "refined": command.refine}
        paths = reconstruct_dataset(*where, command.data, command.indices, **chosen, **options)
    else:
        azimuths = torch.tensor(command.azimuths)
        poses = LookAtPoses(azimuths, command.elevation, DISTANCE, HALF_FOV_DEG) if command.refine else None
        how = {"crop": command.crop, "poses": poses, "plain_background": command.plain_background}
        paths = reconstruct_files(*where, command.images, command.masks, **how, **options)
    for path in paths:
        say(str(path))
    return 0
