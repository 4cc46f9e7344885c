"""Meshes -> a data set in any layout: shaded views, masks, cameras and voxels of every object, by our renderer.

Here meshes are split, scaled, coloured and rendered; `writers` has the cameras and files of each layout.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from tqdm import tqdm

from learn3d.data import conventions
from learn3d.data.dataset import SPLITS
from learn3d.make_data import meshes
from learn3d.make_data.config import DatasetConfig
from learn3d.make_data.folders import check_room, publishing
from learn3d.make_data.report import DatasetReport, report_files, write_report
from learn3d.make_data.writers import WRITERS, RenderedObject, Writer
from learn3d.pictures.contact_sheet import ROWS, make_row
from learn3d.pictures.studio import KEY_LIGHT, photograph, studio_lights

SCALE_RANGE = (0.75, 1.25)  # per-axis scales of the augmented copies


@dataclass(frozen=True)
class Item:
    """A mesh of a data set."""

    number: int  # in the whole data set
    name: str  # of its object
    source: meshes.MeshSource


@dataclass
class Part:
    """The result of rendering some meshes of one split."""

    objects: list[str] = field(default_factory=list)  # names, augmented copies included
    used: list[dict] = field(default_factory=list)  # per mesh: object, name, split, vertices, faces, watertight
    skipped: list[dict] = field(default_factory=list)  # per mesh: name, split, reason
    rows: dict[str, list[np.ndarray]] = field(default_factory=dict)  # of the contact sheet, by object


def make_dataset(config: DatasetConfig, progress: bool = True) -> DatasetReport:
    """Make the data set that `config` describes and return what was done; meshes that cannot be used are skipped.

    Writes the files of the layout (see its class in `learn3d.make_data.writers`) for every split that is not empty,
    `{synset}_card.json` (settings, splits), `{synset}_report.json`, `{synset}_report.txt` and `{synset}_contact.png`
    (see `contact_sheet.LEGEND`). Files appear under their names only when all of them are complete.

    Raises ValueError (settings that do not fit, no usable mesh), FileNotFoundError (no such source), FileExistsError
    (files of the category are there and `overwrite` is off), OSError (folder not writable, disk too full).
    """
    config = config.complete()
    splits, ignored = split_items(config)
    writer_class = WRITERS[config.layout]
    paths = [*writer_class.paths(config.category), *report_files(config.category)]
    there = [path for path in paths if (config.output / path).exists()]
    if there and not config.overwrite:
        raise FileExistsError(
            f"{config.output} already holds {there[0]} and {len(there) - 1} more file(s) or folder(s) of "
            f"{config.category}; give another folder, or --overwrite to replace them"
        )
    count = sum(len(items) * copies_of(config, split) for split, items in splits.items())
    view_bytes = 4 * writer_class.image_size**2 + writer_class.extra_bytes_per_view
    needed = count * (config.views * view_bytes + 32**3) // 2 + 2**24  # renderings shrink to a tenth
    check_room(config.output, needed, f"{count} objects")
    total = sum(map(len, splits.values()))
    with (
        publishing(config.output, [*paths, *writer_class.shared]) as folder,
        tqdm(total=total, desc=config.category, unit="mesh", disable=not progress, dynamic_ncols=True) as bar,
    ):
        writer = writer_class(folder, config.category)
        parts = {split: render_meshes(config, writer, split, items, bar.update) for split, items in splits.items()}
        check_train(parts["train"].objects, parts["train"].skipped)
        objects = writer.finish(config.output, {split: part.objects for split, part in parts.items() if part.objects})
        split_of = {name: split for split, names in objects.items() for name in names}
        used = [mesh | {"split": split_of[mesh["object"]]} for part in parts.values() for mesh in part.used]
        skipped = [mesh for part in parts.values() for mesh in part.skipped]
        rows = {name: row for part in parts.values() for name, row in part.rows.items()}
        sheet = {split: [rows[name] for name in names if name in rows] for split, names in objects.items()}
        files = [path for path in (*writer.paths(config.category), *writer.shared) if (folder / path).exists()]
        counts = {split: len(names) for split, names in objects.items() if names}
        return write_report(config, folder, files, counts, used, skipped, ignored, sheet)


def render_meshes(
    config: DatasetConfig,
    writer: Writer,
    split: str,
    items: Sequence[Item],
    after_each: Callable[[], object] = lambda: None,
) -> Part:
    """Render some meshes of a split and hand their objects to the writer; a mesh that cannot be used is listed."""
    part, copies = Part(), copies_of(config, split)
    writer.start(split, len(items) * copies)
    for item in items:
        names = [item.name, *(f"{item.name}-{copy}" for copy in range(1, copies))]
        try:
            mesh = meshes.checked(item.source.read(), config.max_faces)
            objects = [render(config, writer, mesh, item.number, k, name, split) for k, name in enumerate(names)]
        except ValueError as error:  # it cannot be read, rendered or seen: the others go on
            part.skipped.append({"name": item.source.name, "split": split, "reason": str(error)})
        else:
            for made in objects:
                writer.write(made)
            size = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
            watertight = meshes.is_watertight(mesh.vertices, mesh.faces)
            entry = {"object": item.name, "name": item.source.name, "split": split, **size, "watertight": watertight}
            part.used.append(entry)
            part.objects += names
            if len(part.rows) < ROWS:
                grid = writer.convention.to_object(torch.from_numpy(objects[0].voxels)[None])[0].numpy()
                part.rows[item.name] = make_row(objects[0].rgb, objects[0].alpha, grid)
        after_each()
    return part


def render(
    config: DatasetConfig, writer: Writer, mesh: meshes.RawMesh, number: int, copy: int, name: str, split: str
) -> RenderedObject:
    """Render copy `copy` of mesh `number`: scaled (but for copy 0), coloured, placed.

    Depends on the settings, the mesh and the two numbers alone. Raises ValueError if no view shows any of it.
    """
    rng = np.random.default_rng([config.seed, 1, number, copy])
    scale = rng.uniform(*SCALE_RANGE, size=3)
    color = np.clip(rng.uniform(0.55, 0.9) + rng.uniform(-0.2, 0.2, size=3), 0.35, 1.0).astype(np.float32)  # light grey
    if config.color == "mesh" and mesh.face_colors is not None:
        color = np.where(np.isnan(mesh.face_colors), color, mesh.face_colors)
    vertices = mesh.vertices @ conventions.mesh_to_object(config.up, config.facing).T
    placed = writer.place(meshes.fit_to_box(meshes.fit_to_box(vertices) * (scale if copy else 1.0)))
    rng = np.random.default_rng([config.seed, 2, number, copy])
    poses = writer.views(placed, config.views, rng)
    vertices = torch.as_tensor(np.ascontiguousarray(placed, dtype=np.float32))
    faces = torch.as_tensor(np.ascontiguousarray(mesh.faces, dtype=np.int64))
    lights = studio_lights(tuple((writer.turn @ KEY_LIGHT).tolist()))
    rgb, alpha = photograph(vertices, faces, color, poses.cameras(), image_size=writer.image_size, lights=lights)
    if not alpha.any():
        raise ValueError("no view shows any of it (all faces have no area, or are smaller than a pixel)")
    return RenderedObject(name, split, vertices, faces, poses, rgb, alpha, writer.voxelize(vertices, faces), rng)


def split_items(config: DatasetConfig) -> tuple[dict[str, list[Item]], dict[str, int]]:
    """The meshes of the splits train, val and test, and the number of other files beside them per extension."""
    sources, ignored = meshes.list_sources(config)
    names = meshes.object_names(sources)
    numbers = split_objects(len(sources), config.test, config.val, config.seed)
    return {s: [Item(i, names[i], sources[i]) for i in numbers[s].tolist()] for s in SPLITS}, ignored


def split_objects(count: int, test: float, val: float, seed: int) -> dict[str, np.ndarray]:
    """Object numbers per split, out of one permutation: the first are test, then val, the rest train.

    `test` and `val` are counts, or shares (below 1) that give at least 4 objects, or an equal part if there are few.
    With test = 0.2 and val = 0, test is `default_rng(seed).permutation(count)[:max(4, round(0.2 * count))]`.
    Raises ValueError for a negative or fractional count, and if none would be left to train on.
    """
    sizes = {}
    equal = count // (1 + (test > 0) + (val > 0))
    for name, amount in (("test", test), ("val", val)):
        if not amount >= 0 or (amount >= 1 and amount != int(amount)):
            raise ValueError(f"{name} must be a share in 0 .. 1 or a whole number of meshes, got {amount}")
        least = min(4, equal) if amount > 0 else 0
        sizes[name] = int(amount) if amount >= 1 else max(least, round(amount * count))
    if sum(sizes.values()) >= count:
        raise ValueError(
            f"test ({sizes['test']}) and val ({sizes['val']}) leave none of the {count} meshes to train on; "
            "give more meshes, or a smaller test or val"
        )
    order = np.random.default_rng(seed).permutation(count)
    bounds = np.cumsum([sizes["test"], sizes["val"]])
    return dict(zip(("test", "val", "train"), np.split(order, bounds), strict=True))


def copies_of(config: DatasetConfig, split: str) -> int:
    """Objects that are made of each mesh of a split."""
    return 1 + config.augment if split == "train" else 1


def check_train(objects: Sequence[str], skipped: Sequence[dict]) -> None:
    """Raise ValueError if there is no object to train on."""
    if not objects:
        reasons = "; ".join(f"{mesh['name']}: {mesh['reason']}" for mesh in skipped[:3])
        raise ValueError(f"none of the {len(skipped)} meshes to train on can be used; the first reasons: {reasons}")
