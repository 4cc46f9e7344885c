"""Settings of `learn3d make-dataset`, and the meshes of each split: from files, or generated."""

import itertools
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from trimesh import Trimesh

from learn3d.data import conventions
from learn3d.data.conventions import SPLITS, synset_of
from learn3d.files import identity, npz, sandbox
from learn3d.files.formats import EXTENSIONS, RawMesh, measure_mesh, read_mesh
from learn3d.settings import Count, FilePath, Weight, checked
from learn3d.studio.make_data.writers import WRITERS, WrittenLayout
from learn3d.studio.shapes import CATEGORIES, numbered_shape
from learn3d.tasks import ONE_WORKER, Workers
from learn3d.terminal import progress

MAX_FACES = 1_000_000
_PACK = "an npz file with v0, f0, v1, f1, ... and no pickled objects"
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
WholeNumber = Annotated[int, Field(ge=0)]
WITHOUT_EFFECT = {
    "output",
    "overwrite",
    "shards",
    "workers",
}  # options that do not change the content of the files


@checked
class DatasetConfig:
    """One category of a data set: its meshes, its layout and its splits.

    The same settings give the same bytes.
    """

    output: FilePath
    """Folder for the files. It may hold other categories, too."""
    category: str
    """Name of the category. File names have a synset id instead of each of Kato's 13 names."""
    layout: WrittenLayout = "kato"
    """Published data set whose file layout and viewpoints are used, see docs/data-sets.md."""
    views: Count | None = None
    """Views of each object. If not given: 20 for kar, 8 for pascal3d, 12 for photos and around;
    kato always has 24."""
    source: FilePath | None = None
    """Folder of meshes, searched recursively, or a mesh pack .npz. If not given: shapes from
    --procedural."""
    procedural: WholeNumber = 0
    """Number of shapes from the procedural generator, instead of meshes from files or together with
    them."""
    test: Weight | None = None
    """Share (below 1, at least 4 meshes) or number of the meshes for the test split. If not given:
    0.2; pascal3d has no test split."""
    val: Weight | None = None
    """Share (below 1, at least 4 meshes) or number of the meshes for the validation split, 0 for
    none. If not given: 0.1, for pascal3d 0.2."""
    augment: WholeNumber = 0
    """Additional copies of each training mesh, with each axis scaled by a random factor in 0.75 ..
    1.25. With --source, shapes of --procedural get none."""
    up: Axis = "y"
    """Axis of the mesh files that points up."""
    front: Axis | None = None
    """Axis of the mesh files that faces the camera of view 0. If not given: x, or y if x is up; z
    for procedural shapes."""
    seed: WholeNumber = 0
    """Seed of the splits, scales, colours, views and procedural shapes."""
    overwrite: bool = False
    """Replace files of this category that are already in the folder."""
    shards: bool = False
    """Write shards, for data sets that exceed the memory (docs/scale.md). Only for the layouts kato
    and around. If the command is interrupted, run it again without --overwrite: it continues."""
    workers: Workers = ONE_WORKER

    def __post_init__(self) -> None:
        if self.source is None and self.procedural == 0:
            raise ValueError(
                "give --source (a folder of meshes or a mesh pack .npz), --procedural (a number), or both"
            )
        if self.source and self.procedural and (self.up, self.front_axis) != ("y", "z"):
            raise ValueError(
                "with --procedural, meshes of --source must have its axes: --up y --front z"
            )
        writer = WRITERS[self.layout]
        if self.shards and writer.join is None:
            raise ValueError(
                f"shards need the layout kato or around, not {self.layout}; make the data set without --shards, and "
                "convert it (learn3d convert-dataset)"
            )
        if not self.shards and (self.workers != ONE_WORKER or writer.write is None):
            raise ValueError("--jobs, --cluster and the layout around are for shards: add --shards")
        synset_of(self.category)
        conventions.mesh_to_object(self.up, self.front_axis)
        for name in ("views", "test", "val", "augment"):
            given, usual = getattr(self, name), getattr(writer, f"default_{name}", 0)
            if given is None:
                object.__setattr__(self, name, usual)
            elif given != usual and name in writer.fixed:
                raise ValueError(
                    f"{name} is always {usual:g} in the layout {self.layout}, got {given}; leave it out"
                )

    @property
    def front_axis(self) -> str:
        """Axis of the mesh files that faces the camera of view 0."""
        return self.front or ("z" if self.procedural else "y" if self.up.endswith("x") else "x")

    def to_dict(self) -> dict[str, Any]:
        """The settings that determine the files, as JSON values."""
        settings = {
            name: value for name, value in asdict(self).items() if name not in WITHOUT_EFFECT
        }
        return settings | {"source": self.source and self.source.name}


@dataclass(frozen=True)
class Item:
    """A mesh to render."""

    number: int  # index among all meshes; it seeds scale, colour and views
    name: str  # name of the object, valid as a file name
    split: str
    file: str  # name of the mesh in its source
    read: Callable[[], RawMesh | Trimesh]  # raises ValueError or MissingFile; can be pickled
    copies: int  # objects that are made of it


def split_items(config: DatasetConfig) -> tuple[dict[str, list[Item]], dict[str, str]]:
    """The meshes of each of the splits train, val and test, and the files that are left out, with
    the reason.

    Raises ValueError if there are none to train on.
    """
    if config.procedural and config.category not in CATEGORIES:
        raise ValueError(
            f"the procedural generator makes {', '.join(CATEGORIES)}; got category {config.category!r}"
        )
    sources, left_out = find_meshes(config.source) if config.source else ({}, {})
    augmented = len(sources) or config.procedural
    for i in range(config.procedural):
        sources[f"{config.category}_{i:05d}"] = partial(
            numbered_shape, config.category, config.seed, i
        )
    names, files = object_names(sources), list(sources)
    numbers = split_meshes(len(files), config.test, config.val, config.seed)

    def item(number: int, split: str) -> Item:
        copies = 1 + config.augment if split == "train" and number < augmented else 1
        return Item(number, names[number], split, files[number], sources[files[number]], copies)

    items = {s: [item(number, s) for number in numbers[s].tolist()] for s in SPLITS}
    return items, left_out


def find_meshes(source: Path) -> tuple[dict[str, Callable[[], RawMesh]], dict[str, str]]:
    """A reading function for each object of a folder (by relative path, sorted) or pack, see
    `mesh_sources`, and the files that are left out: name -> reason.

    A folder has each object once (`files.identity`): of several formats the first of `EXTENSIONS`
    that can be read counts, of equal geometries the first name. A pack is used as it is.
    """
    sources, left_out = _sources(source)
    if source.is_dir():
        calls = ([sandbox.Call(measure_mesh, source / name)] for name in sources)
        read = sandbox.read_all(calls)
        bar = progress(read, "compare", unit="mesh", total=len(sources))
        measures = {n: m for n, (m,) in zip(sources, bar, strict=True) if isinstance(m, np.ndarray)}
        names, others = identity.one_format(
            sorted(
                sources, key=lambda n: (n not in measures, EXTENSIONS.index(Path(n).suffix.lower()))
            )
        )
        equal = identity.find_equal({name: measures[name] for name in names if name in measures})
        left_out |= others | dict.fromkeys(equal, "meshes with the geometry of another one")
        sources = {name: sources[name] for name in names if name not in equal}
    return sources, left_out


def mesh_sources(source: Path) -> dict[str, Callable[[], RawMesh]]:
    """A reading function for each mesh of a folder (by relative path, sorted) or pack (by number).

    A pack is an npz file with v0 float [V, 3], f0 int [F, 3], v1, f1, ... Raises ValueError if
    there is no mesh.
    """
    return _sources(source)[0]


def _sources(source: Path) -> tuple[dict[str, Callable[[], RawMesh]], dict[str, str]]:
    left_out: dict[str, str] = {}
    if source.suffix == ".npz" and source.is_file():
        count = sum(name[:1] == "v" and name[1:].isdigit() for name in npz.names(source, _PACK))
        found = {f"{i:0{len(str(count - 1))}d}": partial(_packed, source, i) for i in range(count)}
    else:
        paths, left_out = identity.find_files(source, EXTENSIONS)
        found = {name: partial(read_mesh, path) for name, path in paths.items()}
    if not found:
        wrong = f"there is no mesh in {source}" if source.exists() else f"{source} does not exist"
        wrong = "; ".join([wrong, *identity.describe(left_out)])
        raise ValueError(f"{wrong}; give {_PACK}, or a folder of {', '.join(EXTENSIONS)}")
    return found, left_out


def _packed(path: Path, number: int) -> RawMesh:
    """Mesh `number` of a pack. Raises ValueError if it is damaged."""
    vertices, faces = npz.read_several(path, [f"v{number}", f"f{number}"], _PACK)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or faces.dtype.kind not in "iu":
        found = f"{vertices.dtype} {list(vertices.shape)}, {faces.dtype} {list(faces.shape)}"
        raise ValueError(
            f"not a triangle mesh: wanted vertices float [V, 3] and faces int [F, 3], got {found}"
        )
    return RawMesh(vertices, faces)


def split_meshes(count: int, test: float, val: float, seed: int) -> dict[str, np.ndarray]:
    """Object numbers int64 of each split: a random permutation, cut into test, val and train.

    `test` and `val` are counts, or shares below 1. A share gives at least 4 objects, or an equal
    part of few objects. With test = 0.2 and val = 0, test is
    `default_rng(seed).permutation(count)[:max(4, round(0.2 * count))]`. Raises ValueError if no
    object is left for training.
    """
    least = min(4, count // (1 + (test > 0) + (val > 0)))
    sizes = [
        int(part) if part >= 1 else max(least * (part > 0), round(part * count))
        for part in (test, val)
    ]
    if sum(sizes) >= count:
        raise ValueError(
            f"test ({sizes[0]}) and val ({sizes[1]}) leave none of the {count} meshes to train on; give more meshes, "
            "or a smaller test or val"
        )
    order = np.random.default_rng(seed).permutation(count)
    return dict(zip(("test", "val", "train"), np.split(order, np.cumsum(sizes)), strict=True))


def object_names(files: Iterable[str]) -> list[str]:
    """A unique name for each mesh, valid in file names: letters, digits and underscores."""
    names: dict[str, str] = {}  # keys in lower case, as some file systems ignore case
    for file in files:
        plain = re.sub(r"\W+", "_", str(Path(file).with_suffix(""))).strip("_")[-80:] or "mesh"
        free = itertools.chain([plain], (f"{plain}_{n}" for n in itertools.count(2)))
        name = next(name for name in free if name.lower() not in names)
        names[name.lower()] = name
    return list(names.values())


def check(mesh: RawMesh | Trimesh) -> RawMesh:
    """The mesh without unused vertices. Raises ValueError if it cannot be rendered."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if not 0 < len(faces) <= MAX_FACES:
        raise ValueError(
            f"too large: {len(faces)} faces, the limit is {MAX_FACES}" if len(faces) else "no faces"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"faces refer to vertices {faces.min()} .. {faces.max()}, but there are {len(vertices)}"
        )
    used, faces = np.unique(faces, return_inverse=True)
    vertices = vertices[used].astype(np.float64)
    extent = np.ptp(vertices, axis=0).max()
    if not 1e-12 < extent < 1e30:
        raise ValueError(f"no usable extent: its longest side is {extent:g}")
    return RawMesh(vertices, faces.reshape(-1, 3).astype(np.int64))


def fit_to_box(vertices: np.ndarray) -> np.ndarray:
    """Vertices [V, 3] in a bounding box that is centred at 0 and has the longest side 1."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return (vertices - (low + high) / 2) / (high - low).max()
