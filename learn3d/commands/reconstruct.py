"""`learn3d reconstruct`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.commands.command import Command, Split, Which
from learn3d.terminal import say

_OF_DATASETS = ("category", "split", "indices")
_OF_IMAGES = ("masks", "plain_background", "crop", "azimuths", "elevation")


@dataclass(frozen=True, kw_only=True)
class Reconstruct(Command):
    """Turn images into meshes, each with a turntable animation and a strip of views.

    Examples:
      learn3d reconstruct photo.png --output meshes    (transparent background; the small model of the package)
      learn3d reconstruct photo.jpg --masks mask.png --run runs/airplane --output meshes
      learn3d reconstruct --data DATA --indices 0 31 62 --run runs/airplane --output meshes
    """

    output: Path
    """Folder for the results: of each image a mesh, a turntable GIF and a PNG strip."""
    model: Annotated[Path | None, tyro.conf.arg(name="run")] = None
    """Run folder (or checkpoint file) of the trained model (default: the small model of the package)."""
    images: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="[IMAGE ...]")]] = ()
    """Images of any size, with a transparent background --masks or --plain-background (default: those of --data)."""
    masks: tuple[Path, ...] = ()
    """Mask images (white = object), one for each image (default: the transparency of the images)."""
    plain_background: bool = False
    """The background has one colour: the object is all that differs from the colour of the border."""
    data: Path | None = None
    """Data set from which images are taken (default: image files are given)."""
    category: str | None = None
    """Category in the data set (default: the one that the model was trained on)."""
    split: Split = "test"
    """Part of the data set."""
    indices: tuple[int, ...] = (0,)
    """Images of the data set: object * V + view, if each object has V views (Kato's: 24, Kar's: 20)."""
    format: Literal["glb", "obj", "ply"] = "glb"
    """Format of the mesh files."""
    which: Which = "last"
    """Networks of a run to use: the last ones, or those with the best validation IoU."""
    crop: bool = True
    """Centre and scale the object in each image as in the data set, or leave the images as they are."""
    refine: bool = False
    """Fit each shape to its mask afterwards, a few seconds for each image. The camera must be known: from the data set,
    or by --azimuths."""
    azimuths: tuple[float, ...] = ()
    """Azimuth of the camera of each image file in degrees, for --refine (default: not known). 0: in front of the
    object; 90: at the side that the front view shows on its right."""
    elevation: float = 30.0
    """Elevation of these cameras above the object's plane in degrees."""
    frames: int = 36
    """Pictures of the turntable."""
    image_size: int = 256
    """Side of the turntable in pixels."""

    def run(self) -> None:
        self._check()
        import torch

        from learn3d.data.conventions import DISTANCE, HALF_FOV_DEG
        from learn3d.data.poses import LookAtPoses
        from learn3d.files.writing import check_target
        from learn3d.reconstruction import reconstruct_dataset, reconstruct_files

        check_target(self.output, "--output", folder=True)
        options = {
            "which": self.which,
            "mesh_format": self.format,
            "frames": self.frames,
            "image_size": self.image_size,
        }
        if self.data is not None:
            options |= {"category": self.category, "split": self.split, "refined": self.refine}
            paths = reconstruct_dataset(self.model, self.output, self.data, self.indices, **options)
        else:
            poses = None
            if self.refine:
                poses = LookAtPoses(torch.tensor(self.azimuths), self.elevation, DISTANCE, HALF_FOV_DEG)
            options |= {"crop": self.crop, "poses": poses, "plain_background": self.plain_background}
            paths = reconstruct_files(self.model, self.output, self.images, self.masks, **options)
        for path in paths:
            say(str(path))

    def _check(self) -> None:
        """Raise ValueError if options contradict each other."""
        if bool(self.images) == (self.data is not None):
            raise ValueError("give either image files, or --data with --indices")
        if self.output.suffix.lower() in (".glb", ".obj", ".ply"):
            raise ValueError(f"--output is a folder, got {self.output}; the files in it are named after the images")
        others = _OF_DATASETS if self.images else _OF_IMAGES
        if ignored := [name for name in others if getattr(self, name) != getattr(Reconstruct, name)]:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in ignored)
            given, wanted = ("image files", "--data") if self.images else ("--data", "image files")
            raise ValueError(f"{given} given; leave out what belongs to {wanted}: {options}")
        if self.images and self.refine != bool(self.azimuths):
            raise ValueError("--refine takes the azimuth of each image file's camera: give --refine --azimuths A ...")
        if self.images and not self.refine and self.elevation != Reconstruct.elevation:
            raise ValueError("--elevation is for the cameras that --refine fits to: give --refine --azimuths A ...")
