"""Meshes -> a data set in any layout: shaded views, masks, cameras and voxels of every object, by our renderer.

Here meshes are chosen, split, scaled and coloured; `writers` has the cameras and files of each layout.
"""

from __future__ import annotations

import math
import tempfile
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from learn3d.data import conventions
from learn3d.data.categories import synset_of
from learn3d.files.writing import write_json
from learn3d.make_data import meshes
from learn3d.make_data.config import HOW, DatasetConfig
from learn3d.make_data.contact_sheet import draw_sheet, make_row
from learn3d.make_data.folders import check_room, existing, publish
from learn3d.make_data.report import DatasetReport, lacking
from learn3d.make_data.studio import KEY_LIGHT, photograph, studio_lights
from learn3d.make_data.writers import RenderedObject, Writer, writer_of
from learn3d.make_data.writers.pictures import write_png
from learn3d.terminal import plain

SCALE_RANGE = (0.75, 1.25)  # per-axis scales of the augmented copies
KEPT_ROWS = 60  # of each split: the contact sheet shows some of them


def split_objects(count: int, test: float, val: float, seed: int) -> dict[str, np.ndarray]:
    """Object numbers per split, out of one permutation: the first are test, then val, the rest train.

    `test` and `val` are counts, or shares (below 1) that give at least 4 objects, or an equal part where there are few.
    With test = 0.2 and val = 0, test is `default_rng(seed).permutation(count)[:max(4, round(0.2 * count))]`.
    Raises ValueError for a negative or fractional count, and where none would be left to train on.
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


def make_dataset(config: DatasetConfig, progress: bool = True) -> DatasetReport:
    """Make the data set that `config` describes and return what was done; meshes that cannot be used are skipped.

    Writes the files of the layout (see its module in `learn3d.make_data.writers`) for every split that is not empty,
    `{synset}_card.json` (settings, splits), `{synset}_report.json`, `{synset}_report.txt` and `{synset}_contact.png`
    (see `contact_sheet.LEGEND`). Files appear under their names only when all of them are complete.

    Raises ValueError (settings that do not fit, no usable mesh), FileNotFoundError (no such source), FileExistsError
    (files of the category are there and `overwrite` is off), OSError (folder not writable, disk too full).
    """
    config = config.complete()
    prefix, writer_class = synset_of(config.category), writer_of(config.layout)
    sources, ignored = list_sources(config)
    names = meshes.object_names(sources)
    splits = split_objects(len(sources), config.test, config.val, config.seed)
    copies = {"train": 1 + config.augment, "val": 1, "test": 1}
    _prepare_folder(config, writer_class, sum(len(splits[split]) * copies[split] for split in copies))

    done = _Done()
    with (
        tempfile.TemporaryDirectory(prefix=".make_dataset_", dir=config.output) as temporary,
        tqdm(total=len(sources), desc=config.category, unit="mesh", disable=not progress, dynamic_ncols=True) as bar,
    ):
        folder, trash = Path(temporary) / "new", Path(temporary) / "old"
        folder.mkdir()
        writer = writer_class(folder, config.category)
        for split in copies:
            most = len(splits[split]) * copies[split]
            writer.start(split, most)
            for number in splits[split].tolist():
                try:
                    mesh = meshes.checked(sources[number].read(), config.max_faces)
                    own = [names[number], *(f"{names[number]}-{copy}" for copy in range(1, copies[split]))]
                    items = [render(config, writer, mesh, number, k, name, split) for k, name in enumerate(own)]
                except ValueError as error:  # it cannot be read, rendered or seen: the others go on
                    done.skipped.append({"name": sources[number].name, "split": split, "reason": str(error)})
                else:
                    done.add(writer, sources[number].name, mesh, items, every=math.ceil(most / KEPT_ROWS))
                bar.update()
        if not done.objects["train"]:
            bad = [mesh for mesh in done.skipped if mesh["split"] == "train"]
            raise ValueError(
                f"none of the {len(bad)} meshes to train on can be used; the first reasons: "
                + "; ".join(f"{mesh['name']}: {mesh['reason']}" for mesh in bad[:3])
            )
        objects = writer.finish(config.output, done.objects)
        for split, written in objects.items():  # some layouts decide on the splits at the end
            for name in written:
                done.mesh_of[name]["split"] = split
        rows = {split: [done.rows[name] for name in written if name in done.rows] for split, written in objects.items()}
        write_png(folder / f"{prefix}_contact.png", draw_sheet(rows, config.views))
        own = [path for path in (*writer.paths(config.category), *writer.shared) if (folder / path).exists()]
        files = sorted([*own, *_extra_files(prefix)])
        counts = {split: len(written) for split, written in objects.items() if written}
        skipped, others = done.skipped, dict(sorted(ignored.items()))
        report = DatasetReport(config.category, files, counts, done.used, skipped, others, lacking(writer, counts))
        write_json(folder / f"{prefix}_card.json", _card(config, writer, counts, done.used))
        write_json(folder / f"{prefix}_report.json", asdict(report))
        (folder / f"{prefix}_report.txt").write_text(plain(report.text()) + "\n", encoding="utf-8")
        old = existing(config.output, [*_own_paths(writer_class, config.category), *writer.shared])
        publish(folder, config.output, files, old, trash)
    return report


@dataclass
class _Done:
    """What became of the meshes so far."""

    used: list[dict] = field(default_factory=list)
    skipped: list[dict] = field(default_factory=list)
    objects: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))  # names per split
    mesh_of: dict[str, dict] = field(default_factory=dict)  # entry of `used` per object name
    rows: dict[str, list[np.ndarray]] = field(default_factory=dict)  # of the contact sheet: some objects' pictures

    def add(self, writer: Writer, name: str, mesh: meshes.RawMesh, items: list[RenderedObject], every: int) -> None:
        """Write the objects made from one mesh; every `every`-th object of the split is kept for the contact sheet."""
        size = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
        watertight = meshes.is_watertight(mesh.vertices, mesh.faces)
        entry = {"name": name, "split": items[0].split, **size, "watertight": watertight}
        self.used.append(entry)
        for item in items:
            writer.write(item)
            self.objects[item.split].append(item.name)
            self.mesh_of[item.name] = entry
            if len(self.objects[item.split]) % every == 1 % every:
                grid = writer.convention.to_object(torch.from_numpy(item.voxels)[None])[0].numpy()
                self.rows[item.name] = make_row(item.rgb, item.alpha, grid)


def render(
    config: DatasetConfig, writer: Writer, mesh: meshes.RawMesh, number: int, copy: int, name: str, split: str
) -> RenderedObject:
    """Object `copy` of mesh `number`: scaled, coloured, placed, looked at."""
    rng = np.random.default_rng([config.seed, 1, number, copy])
    scale = rng.uniform(*SCALE_RANGE, size=3)
    color = np.clip(rng.uniform(0.55, 0.9) + rng.uniform(-0.2, 0.2, size=3), 0.35, 1.0).astype(np.float32)  # light grey
    if config.color == "mesh" and mesh.face_colors is not None:
        color = np.where(np.isnan(mesh.face_colors), color, mesh.face_colors)
    vertices = mesh.vertices @ conventions.mesh_to_object(config.up, config.facing).T
    fitted = meshes.fit_to_box(meshes.fit_to_box(vertices) * (scale if copy else 1.0))
    placed = writer.place(fitted)
    rng = np.random.default_rng([config.seed, 2, number, copy])
    poses = writer.views(placed, config.views, rng)
    vertices = torch.as_tensor(np.ascontiguousarray(placed, dtype=np.float32))
    faces = torch.as_tensor(np.ascontiguousarray(mesh.faces, dtype=np.int64))
    lights = studio_lights(tuple((writer.turn @ KEY_LIGHT).tolist()))
    rgb, alpha = photograph(vertices, faces, color, poses.cameras(), image_size=writer.image_size, lights=lights)
    if not alpha.any():
        raise ValueError("no view shows any of it (all faces have no area, or are smaller than a pixel)")
    voxels = writer.voxelize(vertices, faces)
    return RenderedObject(name, split, vertices, faces, poses, rgb, alpha, voxels, rng)


def settings_of(config: DatasetConfig) -> dict:
    """What the files depend on, as plain values."""
    settings = {k: v for k, v in asdict(config).items() if k not in {"output", "overwrite", *HOW}}
    return settings | {"source": None if config.source is None else Path(config.source).name}


def list_sources(config: DatasetConfig) -> tuple[list[meshes.MeshSource], Counter[str]]:
    """The meshes that `config` names, and the files beside them that are no meshes."""
    if config.procedural:
        return meshes.procedural_sources(config.category, config.procedural, config.seed), Counter()
    source = Path(config.source)
    if source.is_dir():
        return meshes.folder_sources(source)
    if source.is_file() and source.suffix == ".npz":
        return meshes.pack_sources(source), Counter()
    if source.exists():
        raise ValueError(f"the source must be a folder of meshes or a mesh pack (.npz), got the file {source}")
    raise FileNotFoundError(f"there is no folder or mesh pack {source}")


def _extra_files(prefix: str) -> list[str]:
    """What lies beside the files of every layout."""
    return [f"{prefix}_{name}" for name in ("card.json", "contact.png", "report.json", "report.txt")]


def _own_paths(writer: type[Writer], category: str) -> list[str]:
    return [*writer.paths(category), *_extra_files(synset_of(category))]


def _prepare_folder(config: DatasetConfig, writer: type[Writer], objects: int) -> None:
    """Create the folder and check that it can take the files: nothing in the way, writable, room on the disk."""
    there = existing(config.output, _own_paths(writer, config.category))
    if there and not config.overwrite:
        raise FileExistsError(
            f"{config.output} already holds {there[0]} and {len(there) - 1} more file(s) or folder(s) of "
            f"{config.category}; give another folder, or --overwrite to replace them"
        )
    needed = objects * (config.views * writer.bytes_per_view + 32**3) // 2 + 2**24  # renderings shrink to a tenth
    check_room(config.output, needed, f"{objects} objects")


def _card(config: DatasetConfig, writer: Writer, objects: dict[str, int], used: list[dict]) -> dict:
    """The data set's card: everything needed to make it again, and which mesh went where."""
    settings = settings_of(config)
    left_out = {"layout"} | ({"views"} if writer.fixed_views else set())
    return {
        **({} if config.layout == "kato" else {"layout": config.layout}),
        **writer.card,
        "objects_fill": writer.objects_fill,
        "object_from_mesh": (writer.turn @ conventions.mesh_to_object(config.up, config.facing)).tolist(),
        "settings": {k: v for k, v in settings.items() if k not in left_out},
        "objects": objects,
        "augmented": f"in train, each mesh is followed by its {config.augment} scaled copies",
        "splits": {split: [mesh["name"] for mesh in used if mesh["split"] == split] for split in objects},
    }
