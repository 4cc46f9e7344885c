"""Reconstruction: from image files, or images of a data set, to mesh files and pictures of them."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from learn3d.data.framing import read_photo
from learn3d.data.layouts import require_folder
from learn3d.data.masks import keep_object
from learn3d.pictures import azimuths_deg
from learn3d.runs import checkpoint
from learn3d.studio.picture_to_mesh.cutting import Box
from learn3d.studio.picture_to_mesh.make import (
    Model,
    check_category,
    input_azimuth_deg,
    load_model,
    reconstruct,
    reconstruct_guesses,
)
from learn3d.studio.picture_to_mesh.read import read_picture
from learn3d.studio.picture_to_mesh.write import MeshFormat, Reconstruction, check_replaced, save
from learn3d.terminal import note


def cut_out_pictures(model: Model, folder: Path) -> Tensor:
    """All PNG files with transparency in a folder as stored images uint8 [M, 4, S, S]. ValueError if there are none."""
    files = sorted(folder.rglob("*.png"))
    if not files:
        raise ValueError(f"there is no PNG file in {folder}; give a folder of cut-out pictures")
    images = []
    for file in files:
        colors, mask = read_photo(file)
        try:
            images.append(model.prepare(colors, keep_object(mask)[0]))
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None
    return torch.from_numpy(np.stack(images))


def reconstruct_files(
    run: Path | None,
    folder: Path,
    images: Sequence[Path],
    masks: Sequence[Path] = (),
    *,
    crop: bool = True,
    box: Box | None = None,
    refined: bool = True,
    category: str | None = None,
    smooth: bool = False,
    guesses: int = 1,
    which: str = "last",
    mesh_format: MeshFormat = "glb",
) -> Iterator[Path]:
    """Reconstruct image files with the networks of a run (see `load_model`) and save the results in `folder`.

    masks: a file for each image. Without them the object is searched in images without
    transparency, and in all of them with a `box` (see `cutting`). refined, category, smooth, guesses: see
    `reconstruct_guesses`. Yields each file when it is written, named after the image, with "-2" and
    so on for further guesses (see `save`). Raises ValueError if a mask is empty, or if a result would
    replace a file that this program has not written. A file that cannot be used is an error after all others are done.
    """
    names = check_files(folder, images, masks, guesses)
    every = [result for name in names for result in _result_names(name, guesses)]
    check_replaced(folder, every, mesh_format)
    model = load_model(run, which)
    if category is not None:
        check_category(model, category)
    faults = []
    for name, image, mask in zip(names, images, masks or [None] * len(images), strict=True):
        try:
            photo = read_picture(image, mask, box)
        except (ValueError, OSError) as error:
            faults.append(error)
            continue
        made = list(
            reconstruct_guesses(
                model,
                photo.colors,
                photo.mask,
                crop=crop,
                refined=refined,
                category=category,
                smooth=smooth,
                guesses=guesses,
            )
        )
        empty = "the shape is empty, as the object is too thin" * (not len(made[0].surface.faces))
        for doubt in filter(None, (photo.doubt, made[0].warning, empty)):
            note(f"warning: {name}: {doubt}")
        if made[0].kind:
            note(f"{name}: category {', '.join(each.kind for each in made)}")
        results = _result_names(name, len(made))
        yield from save(folder, results, made, model.config.layout, mesh_format)
    for error in faults[1:]:
        note(f"error: {error}")
    if faults:
        raise faults[0]


def check_files(
    folder: Path, images: Sequence[Path], masks: Sequence[Path], guesses: int = 1
) -> list[str]:
    """Names for the results of images, numbered if two results would have the same name.

    Raises ValueError if a result would replace a file that was given, or if a mask is missing.
    """
    if masks and len(masks) != len(images):
        raise ValueError(
            f"there are {len(images)} images but {len(masks)} masks; give one mask per image, or none"
        )

    def results() -> list[str]:
        return [result for name in names for result in _result_names(name, guesses)]

    names = [Path(image).stem for image in images]
    if len(set(results())) < len(results()):
        names = [f"{number:03}_{name}" for number, name in enumerate(names)]
    given = {Path(path).resolve() for path in (*images, *masks)}
    if taken := [name for name in results() if Path(folder, f"{name}.png").resolve() in given]:
        raise ValueError(
            f"{taken[0]}.png would replace an image that was given; give another --output"
        )
    return names


def _result_names(name: str, guesses: int) -> list[str]:
    return [name, *(f"{name}-{k}" for k in range(2, guesses + 1))]


def reconstruct_dataset(
    run: Path | None,
    folder: Path,
    data: Path,
    indices: Sequence[int],
    *,
    category: str | None = None,
    split: str = "test",
    which: str = "last",
    refined: bool = False,
    mesh_format: MeshFormat = "glb",
) -> list[Path]:
    """Reconstruct images of a data set (indices object * views + view) and save the results in `folder`.

    refined: fit the shapes to the masks at the data set's poses; ValueError if it has none.
    Returns the files, named after category, split and index (see `save`). ValueError if one would
    replace a file that this program has not written.
    """
    require_folder(data)
    model = load_model(run, which)
    dataset = checkpoint.load_data(model.config, split, data=data, category=category)
    names = [f"{dataset.category}_{split}_{index:06}" for index in indices]
    check_replaced(folder, names, mesh_format)
    batch = dataset.batch(torch.tensor(indices, dtype=torch.int64))
    if refined and batch.poses is None:
        raise ValueError(
            f"the data of {dataset.category} have no poses, which fitting needs; leave out --refine"
        )
    surfaces = reconstruct(
        model.method, batch.images, *((batch.masks, batch.poses) if refined else ())
    )
    stored = batch.images.numpy()
    if batch.poses is None:
        azimuths = [
            input_azimuth_deg(surface, image[3])
            for surface, image in zip(surfaces, stored, strict=True)
        ]
    else:
        azimuths = azimuths_deg(batch.poses).tolist()
    made = list(map(Reconstruction, surfaces, stored, azimuths))
    return save(folder, names, made, model.config.layout, mesh_format)
