"""Meshes -> a data set in Kato's layout: 24 shaded views and 32^3 voxels of every object, by our own renderer."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

import nmr
from learn3d.data import kato, meshes
from learn3d.files import write_json
from learn3d.shading import shade_mesh

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
SCALE_RANGE = (0.75, 1.25)  # per-axis scales of the augmented copies
BYTES_PER_OBJECT = kato.NUM_VIEWS * 4 * kato.IMAGE_SIZE**2 + kato.VOXEL_SIZE**3


@dataclass(frozen=True)
class DatasetConfig:
    """What to make a data set from, and how."""

    output: Path  # folder for the files; other categories may live in it too
    category: str  # name of the category; Kato's 13 names become synset ids in the file names
    source: Path | None = None  # folder of meshes (searched recursively) or a mesh pack (.npz); not with --procedural
    procedural: int = 0  # make this many shapes with the procedural generator instead of reading meshes
    test: float = 0.2  # part of the meshes for the test split: a share below 1 (then at least 4 of them), or a count
    val: float = 0.1  # the same for the validation split; 0 for none
    augment: int = 0  # copies of each training mesh, besides itself, with every axis scaled by a random 0.75 .. 1.25
    up: Axis = "y"  # mesh axis that points up
    front: Axis | None = None  # mesh axis that faces the camera of view 0; default x (y where up is x), procedural z
    color: Literal["random", "mesh"] = "random"  # a random light colour per object, or the mesh's own where it has one
    max_faces: int = 1_000_000  # skip meshes with more faces
    seed: int = 0  # of the split, the scales, the colours and the procedural shapes; same seed, same bytes
    overwrite: bool = False  # replace files of this category that are already in the folder


@dataclass(frozen=True)
class DatasetReport:
    """What `make_dataset` did."""

    category: str
    files: list[str]  # names of the files written, in the folder
    objects: dict[str, int]  # objects per split, augmented copies included
    used: list[dict]  # per mesh: name, split, vertices, faces, watertight
    skipped: list[dict]  # per mesh: name, split, reason
    ignored_files: dict[str, int]  # files in the source folder that are no meshes, per extension

    def text(self) -> str:
        """The report for people."""
        faces = np.array([mesh["faces"] for mesh in self.used])
        watertight = sum(mesh["watertight"] for mesh in self.used)
        lines = [
            f"{self.category}: {len(self.used)} meshes used, {len(self.skipped)} skipped",
            "objects: " + ", ".join(f"{split} {count}" for split, count in self.objects.items()),
            f"faces per mesh: {faces.min()} .. {faces.max()}, median {int(np.median(faces))}; watertight: {watertight}",
        ]
        lines += [f"skipped {mesh['name']} ({mesh['split']}): {mesh['reason']}" for mesh in self.skipped]
        lines += [f"ignored {count} {extension} file(s)" for extension, count in self.ignored_files.items()]
        return "\n".join(lines + ["files: " + ", ".join(self.files)])


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


def random_color(rng: np.random.Generator) -> np.ndarray:
    """One light, slightly tinted grey: float32 [3] in [0.35, 1]."""
    return np.clip(rng.uniform(0.55, 0.9) + rng.uniform(-0.2, 0.2, size=3), 0.35, 1.0).astype(np.float32)


def render_object(vertices: np.ndarray, faces: np.ndarray, face_colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kato's record of one object: images uint8 [24, 4, 64, 64] (inverted RGB, alpha) and voxels bool [32, 32, 32].

    vertices float [V, 3] in the object frame, box centred, longest side 1; faces integer [F, 3]; face_colors float [3]
    or [F, 3]. The alpha is exactly that of `nmr.render_silhouette`. Raises ValueError where no view shows anything.
    """
    vertices = torch.as_tensor(np.ascontiguousarray(vertices, dtype=np.float32))
    faces = torch.as_tensor(np.ascontiguousarray(faces, dtype=np.int64))
    cameras = kato.view_cameras(torch.arange(kato.NUM_VIEWS))
    rgb, _ = shade_mesh(vertices, faces, face_colors, cameras, image_size=kato.IMAGE_SIZE)
    alpha = nmr.render_silhouette(vertices, faces, cameras, image_size=kato.IMAGE_SIZE, anti_aliasing=True)
    if not alpha.any():
        raise ValueError("no view shows any of it (all faces have no area, or are smaller than a pixel)")
    images = np.empty((kato.NUM_VIEWS, 4, kato.IMAGE_SIZE, kato.IMAGE_SIZE), dtype=np.uint8)
    images[:, :3] = 255 - rgb.transpose(0, 3, 1, 2)
    images[:, 3] = np.rint(255 * alpha.numpy())
    return images, kato.voxelize(vertices, faces)[0].numpy()


def make_dataset(config: DatasetConfig, progress: bool = True) -> DatasetReport:
    """Make the data set that `config` describes and return what was done; meshes that cannot be used are skipped.

    Writes `{synset}_{split}_images.npz`, `{synset}_{split}_voxels.npz` for every split that is not empty and
    `{synset}_card.json` (settings, splits), `{synset}_report.json`, `{synset}_report.txt`, `{synset}_contact.png`
    (rows: objects of each split; columns: views 0, 3, ... 21, the mask of view 0, the voxels seen from the front).
    Files appear under their names only when all of them are complete.

    Raises ValueError (settings that do not fit, no usable mesh), FileNotFoundError (no such source), FileExistsError
    (files of the category are there and `overwrite` is off), OSError (folder not writable, disk too full).
    """
    _check(config)
    prefix = kato.synset_of(config.category)
    sources, ignored = _list_sources(config)
    splits = split_objects(len(sources), config.test, config.val, config.seed)
    copies = {split: 1 + (config.augment if split == "train" else 0) for split in splits}
    _prepare_folder(config, prefix, sum(len(splits[s]) * copies[s] for s in splits))

    used, skipped, objects, sheet = [], [], {}, []
    with tempfile.TemporaryDirectory(prefix=".make_dataset_", dir=config.output) as temporary:
        bar = _progress_bar(sum(len(splits[s]) * copies[s] for s in splits), config.category, progress)
        for split in ("train", "val", "test"):
            numbers = splits[split]
            images, voxels = _render_split(config, sources, numbers, split, copies[split], used, skipped, bar)
            if not len(images):
                continue
            objects[split] = len(images)
            np.savez_compressed(Path(temporary) / f"{prefix}_{split}_images.npz", images)
            np.savez_compressed(Path(temporary) / f"{prefix}_{split}_voxels.npz", voxels)
            chosen = np.unique(np.linspace(0, len(images) - 1, 6).astype(int))
            sheet.append(contact_sheet(images[chosen], voxels[chosen]))
        bar.close()
        if "train" not in objects:
            bad = [mesh for mesh in skipped if mesh["split"] == "train"]
            raise ValueError(
                f"none of the {len(bad)} meshes to train on can be used; the first reasons: "
                + "; ".join(f"{mesh['name']}: {mesh['reason']}" for mesh in bad[:3])
            )
        _write_png(Path(temporary) / f"{prefix}_contact.png", np.concatenate(sheet))
        files = sorted([p.name for p in Path(temporary).iterdir()] + [f"{prefix}_{n}" for n in _TEXT_FILES])
        report = DatasetReport(config.category, files, objects, used, skipped, dict(sorted(ignored.items())))
        write_json(Path(temporary) / f"{prefix}_card.json", _card(config, objects, used))
        write_json(Path(temporary) / f"{prefix}_report.json", asdict(report))
        (Path(temporary) / f"{prefix}_report.txt").write_text(report.text() + "\n")
        for name in files:
            os.replace(Path(temporary) / name, config.output / name)
        for stale in _existing(config.output, prefix):  # of an earlier data set with more splits
            if stale.name not in files:
                stale.unlink()
    return report


_TEXT_FILES = ("card.json", "report.json", "report.txt")


def contact_sheet(images: np.ndarray, voxels: np.ndarray) -> np.ndarray:
    """A picture to look at, uint8 [64 N, 64 * 10, 3]: per object 8 views over white, the mask of view 0, its voxels.

    The last column is the occupancy seen along the axis of view 0 (darker = thicker), the same way round as view 0.
    """
    views = 255 - images[:, ::3, :3].transpose(0, 3, 1, 4, 2)  # [N, 64, 8, 64, 3]
    mask = np.repeat(255 - images[:, 0, 3][:, :, None, :, None], 3, axis=4)
    depth = voxels.sum(axis=3)[:, ::-1]  # axes (y, x, -z): rows from the top, columns to the right
    depth = depth / max(1, depth.max()) * 215 + 40 * (depth > 0)
    front = np.repeat(np.repeat(255 - depth.astype(np.uint8), 2, axis=1), 2, axis=2)[:, :, None, :, None]
    sheet = np.concatenate([views, mask, np.repeat(front, 3, axis=4)], axis=2)
    return sheet.reshape(-1, sheet.shape[2] * sheet.shape[3], 3)


def _render_split(
    config: DatasetConfig,
    sources: list[meshes.MeshSource],
    numbers: np.ndarray,
    split: str,
    copies: int,
    used: list[dict],
    skipped: list[dict],
    bar,
) -> tuple[np.ndarray, np.ndarray]:
    """Render the meshes `numbers` of one split, `copies` objects each; appends to `used` and `skipped`."""
    total = len(numbers) * copies
    images = np.empty((total, kato.NUM_VIEWS, 4, kato.IMAGE_SIZE, kato.IMAGE_SIZE), dtype=np.uint8)
    voxels = np.empty((total, *(kato.VOXEL_SIZE,) * 3), dtype=bool)
    done = 0
    for number in numbers.tolist():
        source, rendered = sources[number], 0
        try:
            mesh = meshes.checked(source.read(), config.max_faces)
            vertices = mesh.vertices @ kato.mesh_to_object(config.up, _front(config)).T
            for copy in range(copies):
                rng = np.random.default_rng([config.seed, 1, number, copy])
                scale = rng.uniform(*SCALE_RANGE, size=3)
                color = random_color(rng)
                if config.color == "mesh" and mesh.face_colors is not None:
                    color = np.where(np.isnan(mesh.face_colors), color, mesh.face_colors)
                placed = meshes.fit_to_box(meshes.fit_to_box(vertices) * (scale if copy else 1.0))
                images[done + copy], voxels[done + copy] = render_object(placed, mesh.faces, color)
                rendered += 1
                bar.update()
        except ValueError as error:  # it cannot be read, rendered or seen: the others go on
            skipped.append({"name": source.name, "split": split, "reason": str(error)})
            bar.update(copies - rendered)
            continue
        done += copies
        size = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
        watertight = meshes.is_watertight(mesh.vertices, mesh.faces)
        used.append({"name": source.name, "split": split, **size, "watertight": watertight})
    return images[:done], voxels[:done]


def _front(config: DatasetConfig) -> str:
    return config.front or ("z" if config.procedural else "y" if config.up.endswith("x") else "x")


def _check(config: DatasetConfig) -> None:
    if (config.source is None) == (config.procedural == 0):
        raise ValueError("give either a source (a folder of meshes or a mesh pack .npz) or procedural > 0, not both")
    if config.procedural < 0 or config.augment < 0 or config.max_faces < 1 or config.seed < 0:
        raise ValueError(
            "procedural, augment and seed must not be negative and max_faces must be positive, got "
            f"{config.procedural}, {config.augment}, {config.seed}, {config.max_faces}"
        )
    if config.color not in ("random", "mesh"):
        raise ValueError(f"color must be random or mesh, got {config.color!r}")
    kato.mesh_to_object(config.up, _front(config))
    kato.synset_of(config.category)


def _list_sources(config: DatasetConfig) -> tuple[list[meshes.MeshSource], Counter[str]]:
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


def _existing(out: Path, prefix: str) -> list[Path]:
    """Files of this category that are in the folder now."""
    names = [f"{prefix}_{split}_{kind}.npz" for split in kato.SPLITS for kind in ("images", "voxels")]
    names += [f"{prefix}_{name}" for name in ("contact.png", *_TEXT_FILES)]
    return [out / name for name in names if (out / name).exists()]


def _prepare_folder(config: DatasetConfig, prefix: str, objects: int) -> None:
    """Create the folder and check that it can take the files: nothing in the way, writable, room on the disk."""
    existing = _existing(config.output, prefix)
    if existing and not config.overwrite:
        raise FileExistsError(
            f"{config.output} already holds {existing[0].name} and {len(existing) - 1} more file(s) of "
            f"{config.category}; give another folder, or --overwrite to replace them"
        )
    try:
        config.output.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=config.output):
            pass
    except OSError as error:
        raise OSError(
            f"cannot write into the folder {config.output}: {error}; give another one with --output"
        ) from error
    needed = objects * BYTES_PER_OBJECT // 2 + 2**24  # compressed renderings take a tenth of it
    free = shutil.disk_usage(config.output).free
    if free < needed:
        raise OSError(
            f"{objects} objects may need {needed / 2**20:.0f} MiB but the disk of {config.output} has "
            f"{free / 2**20:.0f} MiB free; free some, give another folder, or use fewer meshes or augmented copies"
        )


def _card(config: DatasetConfig, objects: dict[str, int], used: list[dict]) -> dict:
    """The data set's card: everything needed to make it again, and which mesh went where."""
    settings = {k: v for k, v in asdict(config).items() if k not in ("output", "overwrite")}
    settings["source"] = None if config.source is None else Path(config.source).name
    return {
        "images": "uint8 [N, 24, 4, 64, 64]: RGB = 255 - composite over white, alpha",
        "voxels": "bool [N, 32, 32, 32], axes (y, x, -z) of the object frame",
        "views": "azimuth -15 k, elevation 30, distance 2.732, half field of view 15 degrees",
        "objects_fill": "box centred at the origin, longest side 1",
        "object_from_mesh": kato.mesh_to_object(config.up, _front(config)).tolist(),
        "settings": settings,
        "objects": objects,
        "augmented": f"in train, each mesh is followed by its {config.augment} scaled copies",
        "splits": {split: [mesh["name"] for mesh in used if mesh["split"] == split] for split in objects},
    }


def _progress_bar(total: int, name: str, show: bool):
    from tqdm import tqdm

    return tqdm(total=total, desc=name, unit="object", disable=not show, dynamic_ncols=True)


def _write_png(path: Path, image: np.ndarray) -> None:
    import imageio.v3 as imageio

    imageio.imwrite(path, image)
