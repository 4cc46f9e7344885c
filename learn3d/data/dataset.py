"""A data set: a flat list of views of objects, whatever layout it was read from."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from learn3d.data.batch import Batch, StepViews
from learn3d.data.conventions import VOXEL_SIZE, Definition, VoxelConvention
from learn3d.data.crops import Crops, join
from learn3d.data.disk_array import DiskArray
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.data.view_bins import AngleBins
from learn3d.settings import checked

MASK_SIZE = 64
SPLITS = ("train", "val", "test")


@checked
class DatasetInfo:
    """Facts about the data that a method needs before it builds its networks. They are saved in every checkpoint."""

    num_views: Annotated[int, Field(ge=0, le=100_000)]  # K pose classes
    num_classes: Annotated[int, Field(ge=1, le=10_000)] = 1  # categories in the set
    pose_features: Annotated[int, Field(ge=0, le=64)] = 3  # of a camera: eye position 3, rotation 9, unknown 0
    inverted: bool = False  # colours are stored as 255 - colour
    mirror_plane_deg: float | None = None  # result of `data.mirror_plane`; None: no plane, or it was not asked for
    cube_side: float | None = None  # side of the cube, centred at the origin, that holds all objects; None: unknown


@dataclass(frozen=True, eq=False)
class ViewDataset:
    """One split of one category, or of several: M views (samples) of N objects. What every reader returns.

    Images, masks, voxels and points are in memory, or on disk where they were read from shards (`data.shards`).

    Raises ValueError where the parts do not fit each other.
    """

    category: str  # what the user called it; several names are joined by commas
    split: str
    images: np.ndarray | DiskArray  # uint8 [M, 4, S, S]: R, G, B and the mask
    poses: Poses | None  # M camera poses; None where they are not known
    view_ids: np.ndarray  # int64 (int32 where on disk) [M] in 0 .. K-1: pose classes
    view_names: tuple[str, ...]  # K names of the pose classes
    object_ids: np.ndarray  # likewise, in 0 .. N-1
    object_names: tuple[str, ...]  # N names, as in the files
    voxels: (
        np.ndarray | DiskArray | None
    )  # bool [N, 32, 32, 32] in the data set's own axes; None where there is no ground truth
    convention: VoxelConvention  # how predictions are brought into those axes
    masks: np.ndarray | DiskArray | None = (
        None  # uint8 [M, 64, 64] silhouettes to be matched; None: the images' fourth channel
    )
    class_ids: np.ndarray | None = None  # int64 [N]: category of each object, None for a single category
    class_names: tuple[str, ...] = ()  # names of the categories; () for a single one
    points: np.ndarray | DiskArray | None = (
        None  # float32 [N, P, 3]: points on the true surfaces in the object frame, where known
    )
    inverted: bool = True  # colours stored as 255 - colour over black (Kato's form), or as they are
    crops: Crops | None = None  # M: what the augmentation "crop" cuts the images' colours from; None: it is not known
    sides: np.ndarray | None = None  # float32 [M]: `object_sides`, where they are known already
    notes: tuple[str, ...] = ()  # what to warn of: shards that could not be read

    def __post_init__(self) -> None:
        m, n = len(self.images), len(self.object_names)
        if self.images.ndim != 4 or self.images.shape[1] != 4 or self.images.dtype != np.uint8:
            raise ValueError(f"images must be uint8 [M, 4, S, S], got {self.images.dtype} {list(self.images.shape)}")
        if self.masks is None and self.images.shape[2:] != (MASK_SIZE, MASK_SIZE):
            raise ValueError(f"images of {self.images.shape[2:]} pixels need masks [M, {MASK_SIZE}, {MASK_SIZE}]")
        wanted = dict.fromkeys(("poses", "view_ids", "object_ids", "masks", "crops", "sides"), m)
        wanted |= dict.fromkeys(("voxels", "points", "class_ids"), n)
        sizes = {name: len(getattr(self, name)) for name in wanted if getattr(self, name) is not None}
        if wrong := {name: size for name, size in sizes.items() if size != wanted[name]}:
            raise ValueError(f"{m} images of {n} objects do not go with {wrong}")
        if self.voxels is not None and self.voxels.shape[1:] != (VOXEL_SIZE,) * 3:
            raise ValueError(f"voxels must be [N, {VOXEL_SIZE}, {VOXEL_SIZE}, {VOXEL_SIZE}]")
        for name, values, end in (("view_ids", self.view_ids, self.num_views), ("object_ids", self.object_ids, n)):
            if m and not (values.min() >= 0 and values.max() < end):
                raise ValueError(f"{name} must lie in 0 .. {end - 1}, got {values.min()} .. {values.max()}")

    def __len__(self) -> int:
        return len(self.images)

    @property
    def num_objects(self) -> int:
        """N."""
        return len(self.object_names)

    @property
    def num_views(self) -> int:
        """K, the number of pose classes."""
        return len(self.view_names)

    @property
    def num_classes(self) -> int:
        """Number of categories in the set, at least 1."""
        return max(1, len(self.class_names))

    @property
    def image_size(self) -> int:
        """S: side of the images in pixels."""
        return self.images.shape[2]

    @property
    def pose_features(self) -> int:
        """Numbers that describe a pose (`Poses.features`); 0 where poses are not known."""
        return 0 if self.poses is None else self.poses.num_features

    def info(self, mirror_plane_deg: float | None = None) -> DatasetInfo:
        """The facts that a method needs, with the mirror plane of the objects, if it is known."""
        known = (self.num_views, self.num_classes, self.pose_features, self.inverted)
        cube_side = None if self.voxels is None else self.convention.box
        return DatasetInfo(*known, mirror_plane_deg=mirror_plane_deg, cube_side=cube_side)

    def batch(self, indices: Tensor, rows: Tensor | None = None, *, voxels: bool = True) -> Batch:
        """The samples `indices`, integer [B] in 0 .. M-1, as one Batch on the CPU.

        With `rows`, int64 [b], only these of them, as a part of the whole batch. Without `voxels` they are left out:
        training has no use for them, and they are twice as large as the images.
        """
        indices = torch.as_tensor(indices)
        if indices.ndim != 1 or indices.is_floating_point() or indices.dtype == torch.bool:
            raise TypeError(f"indices must be an integer tensor [B], got {indices.dtype} {list(indices.shape)}")
        indices = indices.to(torch.int64)
        if len(indices) and (indices.min() < 0 or indices.max() >= len(self)):
            raise ValueError(
                f"indices must lie in 0 .. {len(self) - 1} ({len(self)} views of {self.num_objects} objects), "
                f"got {int(indices.min())} .. {int(indices.max())}"
            )
        if rows is not None:
            view_ids = torch.from_numpy(self.view_ids[indices.numpy()]).to(torch.int64)
            views = StepViews(rows, self._poses(indices), view_ids, self._classes(indices))
            return dataclasses.replace(self.batch(indices[rows], voxels=voxels), part_of=views)
        samples = indices.numpy()
        images = torch.from_numpy(self.images[samples])
        masks = images[:, 3] if self.masks is None else torch.from_numpy(self.masks[samples])
        objects = self.object_ids[samples].astype(np.int64)
        return Batch(
            images=images,
            masks=masks.to(torch.float32) / 255,
            poses=self._poses(indices),
            view_ids=torch.from_numpy(self.view_ids[samples]).to(torch.int64),
            object_ids=torch.from_numpy(objects),
            class_ids=self._classes(indices),
            voxels=torch.from_numpy(self.voxels[objects]) if voxels and self.voxels is not None else None,
            crops=None if self.crops is None else self.crops[samples],
        )

    def _poses(self, indices: Tensor) -> Poses | None:
        return None if self.poses is None else self.poses[indices]

    def _classes(self, indices: Tensor) -> Tensor:
        if self.class_ids is None:
            return torch.zeros(len(indices), dtype=torch.int64)
        return torch.from_numpy(self.class_ids[self.object_ids[indices.numpy()]])

    def voxelize(self, vertices: Tensor, faces: Tensor, definition: Definition = "kato18") -> Tensor:
        """Occupancy bool [B, 32, 32, 32] of predictions in the data set's voxel axes; see `VoxelConvention`."""
        return self.convention.voxelize(vertices, faces, definition)

    def prepare(self, indices: Tensor, rows: Tensor | None = None) -> None:
        """Begin to read what `batch` will be asked for next, where it is on disk."""
        samples = (indices if rows is None else indices[rows]).numpy()
        for array in (self.images, self.masks):
            if isinstance(array, DiskArray):
                array.prepare(samples)

    def digest(self, *, voxels: bool = True) -> int:
        """CRC-32 of all that is learnt from: images, masks, poses, classes; and of the voxels, if they are wanted.

        Of arrays on disk, of their checksums.
        """
        fields = () if self.poses is None else dataclasses.fields(self.poses)
        poses = [np.asarray(getattr(self.poses, field.name)) for field in fields]
        parts = [self.images, self.masks, *poses, self.view_ids, self.object_ids, self.class_ids]
        crc = 0
        for part in parts + [self.voxels] * voxels:
            crc = _crc(part, crc) if part is not None else crc
        return crc

    def check_masks(self) -> str:
        """What to warn of where some images show nothing; "" for none. Raises ValueError where all of them do."""
        empty = int((self.object_sides() == 0).sum())
        if empty == len(self):
            raise ValueError(
                f"all {empty} {self.split} images of {self.category} have an empty mask, so that there is nothing to "
                "learn; look at the data (learn3d check-dataset)"
            )
        return f"{empty} of {len(self)} {self.split} images have an empty mask" if empty else ""

    def object_share(self) -> float:
        """Mean of `object_sides`.

        Kept in checkpoints, so that photographs can be framed like the images that the networks know.
        """
        return float(self.object_sides().mean(dtype=np.float64))

    def object_sides(self) -> np.ndarray:
        """The larger side of each mask's bounding box, as a share of the picture's side: floats [M], 0 where empty."""
        if self.sides is not None:
            return self.sides
        masks = self.images[:, 3] > 127
        sides = []
        for axis in (1, 2):
            seen = masks.any(axis=axis)
            size = seen.shape[1]
            first, last = seen.argmax(axis=1), size - 1 - seen[:, ::-1].argmax(axis=1)
            sides.append(np.where(seen.any(axis=1), last - first + 1, 0) / size)
        return np.maximum(*sides)

    def mask_pixels(self, samples: np.ndarray) -> np.ndarray:
        """The masks of the samples, uint8 [B, 64, 64]."""
        return self.images[samples][:, 3] if self.masks is None else self.masks[samples]

    def with_bins(self, bins: AngleBins) -> ViewDataset:
        """The same views with pose classes from cells of azimuth and elevation."""
        if not isinstance(self.poses, LookAtPoses):
            got = "no poses" if self.poses is None else "rotations"
            raise ValueError(f"cells of azimuth and elevation need look-at cameras; this data set has {got}")
        return dataclasses.replace(self, view_ids=bins.ids(self.poses).numpy(), view_names=tuple(bins.names()))

    def with_few_views(self, count: int) -> ViewDataset:
        """`count` views of every object, drawn at random for each, the same ones in every run; all, where it has fewer.

        Raises ValueError where no object has so many.
        """
        order = np.random.default_rng(0).permutation(len(self))
        order = order[np.argsort(self.object_ids[order], kind="stable")]  # by object, the views of each shuffled
        _, starts, sizes = np.unique(self.object_ids[order], return_index=True, return_counts=True)
        if not 1 <= count <= sizes.max(initial=0):
            raise ValueError(f"views_per_object must lie in 1 .. {sizes.max(initial=0)}, got {count}")
        number = np.arange(len(self)) - np.repeat(starts, sizes)
        return self.select(np.sort(order[number < count]))

    def select(self, samples: np.ndarray) -> ViewDataset:
        """Only the samples `samples`, int64; all objects stay."""
        return dataclasses.replace(
            self,
            images=_taken(self.images, samples),
            masks=None if self.masks is None else _taken(self.masks, samples),
            sides=None if self.sides is None else self.sides[samples],
            poses=self._poses(torch.from_numpy(samples)),
            view_ids=self.view_ids[samples],
            object_ids=self.object_ids[samples],
            crops=None if self.crops is None else self.crops[samples],
        )


def concatenate(datasets: Sequence[ViewDataset]) -> ViewDataset:
    """Several categories of one layout and split as one set with class ids; their view classes must be the same."""
    first = datasets[0]
    if len(datasets) == 1:
        return first
    for other in datasets[1:]:
        if other.view_names != first.view_names or other.images.shape[1:] != first.images.shape[1:]:
            raise ValueError(f"{other.category} and {first.category} differ in view classes or image size")

    def joined(name: str) -> np.ndarray | DiskArray | None:
        parts = [getattr(d, name) for d in datasets]
        if any(part is None for part in parts):
            return None
        stored = [isinstance(part, DiskArray) for part in parts]
        if any(stored) and not all(stored):
            raise ValueError(f"of {', '.join(d.category for d in datasets)} some are in shards; convert all, or none")
        return DiskArray.join(parts) if all(stored) else np.concatenate(parts)

    starts = np.cumsum([0] + [d.num_objects for d in datasets])[:-1]
    return dataclasses.replace(
        first,
        category=",".join(d.category for d in datasets),
        **{name: joined(name) for name in ("images", "masks", "view_ids", "voxels", "points", "sides")},
        poses=_join_poses([d.poses for d in datasets]),
        object_ids=np.concatenate([d.object_ids + start for d, start in zip(datasets, starts, strict=True)]),
        object_names=tuple(name for d in datasets for name in d.object_names),
        crops=None if any(d.crops is None for d in datasets) else join([d.crops for d in datasets]),
        class_ids=np.repeat(np.arange(len(datasets)), [d.num_objects for d in datasets]),
        class_names=tuple(d.category for d in datasets),
        notes=tuple(note for d in datasets for note in d.notes),
    )


def _crc(array: np.ndarray | DiskArray, crc: int) -> int:
    if isinstance(array, DiskArray):
        return zlib.crc32(array.digest().to_bytes(4, "little"), crc)
    return zlib.crc32(np.ascontiguousarray(array), crc)


def _taken(array: np.ndarray | DiskArray, samples: np.ndarray) -> np.ndarray | DiskArray:
    """Rows of an array, which stay where they are."""
    return array.select(samples) if isinstance(array, DiskArray) else array[samples]


def _join_poses(poses: list[Poses | None]) -> Poses | None:
    kind = type(poses[0])
    if any(type(p) is not kind for p in poses):
        raise ValueError("the categories have cameras of different kinds")
    if poses[0] is None:
        return None
    joined = {}
    for field in dataclasses.fields(kind):
        values = [getattr(p, field.name) for p in poses]
        if any(isinstance(v, Tensor) for v in values) or len(set(values)) > 1:  # else one number for all
            parts = [torch.as_tensor(v, dtype=torch.float32) for v in values]
            parts = [v if v.ndim else v.expand(len(p)) for v, p in zip(parts, poses, strict=True)]
            values = [torch.cat(parts)]
        joined[field.name] = values[0]
    return kind(**joined)
