"""Measures how often pictures of other things get a warning, and pictures of known kinds a false one.

python tools/measure_others.py --others accessories icons --known chairs tables
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import tyro

from learn3d.data.conventions import mesh_to_object, view_poses
from learn3d.data.framing import read_photo
from learn3d.data.masks import keep_object
from learn3d.files.formats import RawMesh
from learn3d.pictures import photograph
from learn3d.studio.make_data.looks import natural_look
from learn3d.studio.make_data.meshes import check, fit_to_box, mesh_sources
from learn3d.studio.picture_to_mesh.make import load_model, recognize
from learn3d.studio.shapes import make_shape

SEED = 77  # of generated objects, other ones than the model was trained on

Picture = tuple[np.ndarray, np.ndarray]  # colours uint8 [H, W, 3] and mask uint8 [H, W]


def draw(mesh: RawMesh, rng: np.random.Generator) -> Picture:
    """A mesh (y up, front towards +z) in everyday colours from one of Kato's 24 cameras, 256 pixels a side."""
    vertices = np.float32(fit_to_box(mesh.vertices) @ mesh_to_object("y", "z").T)
    cameras = view_poses(torch.from_numpy(rng.integers(24, size=1))).cameras()
    colors, lights = natural_look(vertices, mesh.faces, rng)
    (rgb,), (alpha,) = photograph(
        vertices, mesh.faces, colors, cameras, image_size=256, lights=lights
    )
    return rgb, alpha


def pictures_of(folder: Path, most: int) -> Iterator[Picture]:
    """At most so many pictures of a folder, evenly chosen: its PNG files with transparency, or one of each mesh."""
    files = sorted(folder.rglob("*.png"))
    sources = [] if files else list(mesh_sources(folder).values())
    count = len(files) or len(sources)
    for number in np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)):
        if files:
            colors, mask = read_photo(files[number])
            yield colors, keep_object(mask)[0]
        else:
            yield draw(check(sources[number]()), np.random.default_rng(number))


def generated(category: str, count: int) -> Iterator[Picture]:
    """Pictures of generated objects of a category."""
    for number in range(count):
        rng = np.random.default_rng([SEED, number])
        yield draw(make_shape(category, rng), rng)


def main(
    others: tuple[Path, ...] = (),
    known: tuple[Path, ...] = (),
    run: Path | None = None,
    images: int = 60,
) -> None:
    """Print the share of pictures with a warning: it should be large for other things, small for known kinds.

    others, known: folders of PNG files with transparency, or of meshes, that the model was not
    trained on.
    run: the model (default: the package's). images: most pictures of each folder, and of each
    generated category.
    """
    torch.set_num_threads(1)
    model = load_model(run)
    groups = [("generated", category, generated(category, images)) for category in model.categories]
    groups += [("known", folder.name, pictures_of(folder, images)) for folder in known]
    groups += [("others", folder.name, pictures_of(folder, images)) for folder in others]
    warned: dict[str, list[bool]] = {}
    for group, name, pictures in groups:
        found = []
        for picture in pictures:
            with torch.no_grad():
                chances = model.chances(torch.from_numpy(model.prepare(*picture)))
            found.append(recognize(model, chances)[1] is not None)
        print(f"{group:12}{name:16}{len(found):6}{np.mean(found):8.1%}", flush=True)
        warned.setdefault(group, []).extend(found)
    for group, found in warned.items():
        print(f"{group:12}{'all':16}{len(found):6}{np.mean(found):8.1%}")


if __name__ == "__main__":
    tyro.cli(main)
