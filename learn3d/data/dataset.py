"""A data set of any layout, a flat list of views of objects, and the batches of it."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

import nmr
from learn3d.data.conventions import VOXEL_SIZE, VoxelConvention
from learn3d.data.poses import LookAtPoses, PoseCandidates, Poses
from learn3d.data.view_bins import AngleBins
from learn3d.files.limits import MASK_SIZE
from learn3d.settings import checked

if TYPE_CHECKING:
    from learn3d.data.crops import Crops
    from learn3d.data.disk_array import DiskArray

    Array = np.ndarray | DiskArray


# fields of `ViewDataset` with a value for each view that are None if unknown, and the images
_OF_VIEWS = ("images", "masks", "depth", "poses", "stored_sizes", "crops")


@checked
class DatasetInfo:
    """Properties of the data that methods need to build their networks.

    Every checkpoint has them.
    """

    num_views: Annotated[int, Field(ge=0, le=100_000)]  # K view classes
    inverted: bool  # colours are stored as 255 - colour
    num_classes: Annotated[int, Field(ge=1, le=10_000)] = 1  # number of categories
    # length of `features` of a pose; 0 if poses are unknown
    pose_features: Annotated[int, Field(ge=0, le=64)] = 3
    # result of `data.mirror_plane`; None if none was found or looked for
    mirror_plane_deg: float | None = None
    # side of the cube, centred at the origin, that holds all objects; None if unknown
    cube_side: float | None = None
    solidity: float | None = None  # result of `ViewDataset.solidity`; None if not computed


@dataclass(frozen=True, eq=False)
class Batch:
    """B views for training or evaluation."""

    images: Tensor  # uint8 [B, 4, S, S]: R, G, B and the mask; input of the encoder
    masks: Tensor  # float32 [B, 64, 64] in [0, 1]: ground truth silhouettes, row 0 = top
    poses: Poses | None  # B poses; None if unknown
    view_ids: Tensor  # int64 [B] in 0 .. K-1: view classes
    object_ids: Tensor  # int64 [B]: the object in each view, by its number in the split
    class_ids: Tensor  # int64 [B]: the category of each object; 0 if there is only one
    # bool [B, 32, 32, 32]: ground truth in the data set's axes; None if unknown
    voxels: Tensor | None
    crops: Crops | None = None  # original images for the augmentation "crop"; None if unknown
    # float32 [B, 64, 64]: along the optical axis, 0: no surface; None if unknown
    depth: Tensor | None = None

    def __len__(self) -> int:
        return len(self.images)

    @property
    def cameras(self) -> nmr.cameras.Camera:
        """The B cameras of the images; their poses must be known."""
        return self.poses.cameras()


@dataclass(frozen=True, eq=False)
class ViewDataset:
    """One split of one category or of several: M views (samples) of N objects.

    Images, masks, depth, voxels and points are in memory, or on disk if they were read from
    shards (`data.shards`). Raises ValueError if fields have different numbers of views or
    objects, or wrong shapes.
    """

    category: str  # name from the user; several names are joined by commas
    split: str
    images: Array  # uint8 [M, 4, S, S]: R, G, B and the mask
    poses: Poses | None  # M camera poses; None if they are unknown
    view_ids: np.ndarray  # int64 (int32 if on disk) [M] in 0 .. K-1: view classes
    view_names: tuple[str, ...]  # K names of the view classes
    object_ids: np.ndarray  # int64 (int32 if on disk) [M] in 0 .. N-1: the object in each view
    object_names: tuple[str, ...]  # N names from the files
    # bool [N, 32, 32, 32] ground truth in the data set's own axes; None if unknown
    voxels: Array | None
    convention: VoxelConvention  # axes of the voxels
    inverted: bool  # True if colours are stored as 255 - colour, so that a white background is 0 (Kato's form)
    # uint8 [M, 64, 64] ground truth silhouettes; None: the images' fourth channel
    masks: Array | None = None
    depth: Array | None = None  # uint8 [M, 64, 64], see `depth_levels`; None if unknown
    # int64 [N]: category of each object; None for a single category
    class_ids: np.ndarray | None = None
    class_names: tuple[str, ...] = ()  # names of the categories; () for a single one
    # float32 [N, P, 3]: points on the true surfaces in the object frame; None if unknown
    points: Array | None = None
    crops: Crops | None = None  # M original images for the augmentation "crop"; None if unknown
    stored_sizes: np.ndarray | None = None  # float32 [M]: `object_sizes`; None if not computed
    # M sets of poses for training to draw from; None: `poses` alone
    candidates: PoseCandidates | None = None

    def __post_init__(self) -> None:
        m = len(self.images)
        n = self.num_objects
        side = self.images.shape[-1]
        if self.images.shape != (m, 4, side, side) or self.images.dtype != np.uint8:
            raise ValueError(
                f"images must be uint8 [M, 4, S, S], got {self.images.dtype} {list(self.images.shape)}"
            )
        if self.masks is None and side != MASK_SIZE:
            raise ValueError(f"images of {side} pixels need masks of {MASK_SIZE}, got None")
        wanted = dict.fromkeys(("masks", "depth"), (m, MASK_SIZE, MASK_SIZE))
        wanted |= dict.fromkeys(
            ("poses", "view_ids", "object_ids", "crops", "stored_sizes", "candidates"), (m,)
        )
        wanted |= {"voxels": (n, *[VOXEL_SIZE] * 3), "points": (n,), "class_ids": (n,)}
        for name, shape in wanted.items():
            if (part := getattr(self, name)) is not None:
                found = getattr(part, "shape", (len(part),))
                if found[: len(shape)] != shape:
                    raise ValueError(
                        f"{name} of {m} images of {n} objects must be {list(shape)}, got {list(found)}"
                    )
        for name, end in (("view_ids", self.num_views), ("object_ids", n)):
            values = getattr(self, name)
            if m and not (values.min() >= 0 and values.max() < end):
                raise ValueError(
                    f"{name} must lie in 0 .. {end - 1}, got {values.min()} .. {values.max()}"
                )

    def __len__(self) -> int:
        return len(self.images)

    @property
    def num_objects(self) -> int:
        """N."""
        return len(self.object_names)

    @property
    def num_views(self) -> int:
        """K, the number of view classes."""
        return len(self.view_names)

    @property
    def num_classes(self) -> int:
        """Number of categories in the set, at least 1."""
        return max(1, len(self.class_names))

    @property
    def image_size(self) -> int:
        """S: side of the images in pixels."""
        return self.images.shape[2]

    def info(
        self, mirror_plane_deg: float | None = None, solidity: float | None = None
    ) -> DatasetInfo:
        """The properties that methods need; None for an unknown mirror plane or solidity."""
        features = 0 if self.poses is None else self.poses.num_features
        cube_side = None if self.voxels is None else self.convention.cube_side
        sizes = self.num_views, self.inverted, self.num_classes, features
        return DatasetInfo(*sizes, mirror_plane_deg, cube_side, solidity)

    def batch(self, indices: Tensor, *, voxels: bool = True) -> Batch:
        """The samples `indices`, integer [B] from 0 to M-1, as one Batch on the CPU.

        Raises ValueError for other indices.

        voxels: False for training, which needs none; they are twice as large as the images.
        """
        indices = torch.as_tensor(indices, dtype=torch.int64)
        samples = indices.numpy()
        if len(samples) and not 0 <= samples.min() <= samples.max() < len(self):
            given = f"{samples.min()} .. {samples.max()}"
            # --indices of commands
            raise ValueError(f"indices must lie in 0 .. {len(self) - 1}, got {given}")
        images = self.images[samples]
        masks = images[:, 3] if self.masks is None else self.masks[samples]
        poses = None if self.poses is None else self.poses[indices]
        view_ids, objects = (
            array[samples].astype(np.int64) for array in (self.view_ids, self.object_ids)
        )
        classes = np.zeros_like(objects) if self.class_ids is None else self.class_ids[objects]
        return Batch(
            images=torch.from_numpy(images),
            masks=torch.from_numpy(np.divide(masks, 255, dtype=np.float32)),
            poses=poses,
            view_ids=torch.from_numpy(view_ids),
            object_ids=torch.from_numpy(objects),
            class_ids=torch.from_numpy(classes),
            voxels=torch.from_numpy(self.voxels[objects])
            if voxels and self.voxels is not None
            else None,
            crops=None if self.crops is None else self.crops[samples],
            depth=None
            if self.depth is None
            else depth_of_levels(torch.from_numpy(self.depth[samples]), poses),
        )

    def digest(self, *, voxels: bool = True) -> int:
        """CRC-32 of images, masks, poses and classes, and of voxels if wanted.

        Arrays on disk count by checksums.
        """
        poses = () if self.poses is None else vars(self.poses).values()
        parts = [
            self.images,
            self.masks,
            self.depth,
            *poses,
            self.view_ids,
            self.object_ids,
            self.class_ids,
        ]
        if self.candidates is not None:
            parts += [
                self.candidates.weights,
                self.candidates.poses.azimuth_deg,
                self.candidates.view_ids,
            ]
        crc = 0
        for part in parts + [self.voxels] * voxels:
            if part is not None:
                on_disk = hasattr(part, "digest")
                stored = np.array(part.digest(), "<u4") if on_disk else part
                crc = zlib.crc32(np.ascontiguousarray(stored), crc)
        return crc

    def check_masks(self) -> str:
        """A warning if some masks are empty, else "". Raises ValueError if all masks are empty."""
        empty = int((self.object_sizes() == 0).sum())
        if empty == len(self):
            found = f"all {empty} {self.split} images of {self.category} have an empty mask"
            raise ValueError(f"{found}; run learn3d check-dataset on the data")
        return f"{empty} of {len(self)} {self.split} images have an empty mask" if empty else ""

    def mean_object_size(self) -> float:
        """Mean of `object_sizes`: the scale at which `reconstruct` frames photographs."""
        return float(self.object_sizes().mean(dtype=np.float64))

    def solidity(self) -> float:
        """Mean ratio of a mask's area to that of its convex hull, for at most 256 images; 0 if
        all masks are empty.
        """
        from skimage.morphology import convex_hull_image  # takes half a second to import

        masks = (
            self.read_masks(np.linspace(0, len(self) - 1, min(len(self), 256)).astype(int)) > 127
        )
        return float(
            np.mean(
                [mask.sum() / convex_hull_image(mask).sum() for mask in masks if mask.any()] or 0.0
            )
        )

    def read_masks(self, samples: np.ndarray) -> np.ndarray:
        """The ground truth silhouettes of the samples `samples`, int64 [B]: uint8 [B, 64, 64]."""
        return self.images[samples][:, 3] if self.masks is None else self.masks[samples]

    def object_sizes(self) -> np.ndarray:
        """The larger side of each mask's bounding box over the side of the image: float [M], 0
        for an empty mask.
        """
        if self.stored_sizes is not None:
            return self.stored_sizes
        masks = self.images[:, 3] > 127
        sides = []
        for axis in (1, 2):
            seen = masks.any(axis=axis)
            before, after = seen.argmax(axis=1), seen[:, ::-1].argmax(axis=1)
            sides.append(
                np.where(seen.any(axis=1), seen.shape[1] - before - after, 0) / seen.shape[1]
            )
        return np.maximum(*sides)

    def with_bins(self, bins: AngleBins) -> ViewDataset:
        """The same views with cells of azimuth and elevation as view classes.

        Raises ValueError without such poses.
        """
        if not isinstance(self.poses, LookAtPoses):
            got = "no poses" if self.poses is None else "rotations"
            raise ValueError(
                f"cells of azimuth and elevation need look-at cameras; this data set has {got}"
            )
        candidates = self.candidates
        if candidates is not None:
            candidates = dataclasses.replace(
                candidates, view_ids=bins.ids(candidates.poses).numpy()
            )
        parts = {"view_names": tuple(bins.names()), "candidates": candidates}
        return dataclasses.replace(self, view_ids=bins.ids(self.poses).numpy(), **parts)

    def with_few_views(self, count: int, first: bool = False) -> ViewDataset:
        """`count` random views of each object, the same ones in every run, or its first ones; all
        views of objects that have no more.

        Raises ValueError if no object has `count` views.
        """
        order = np.arange(len(self)) if first else np.random.default_rng(0).permutation(len(self))
        # sorted by object, in this order within it
        order = order[np.argsort(self.object_ids[order], kind="stable")]
        _, starts, sizes = np.unique(self.object_ids[order], return_index=True, return_counts=True)
        if not 1 <= count <= sizes.max(initial=0):
            raise ValueError(
                f"views_per_object must lie in 1 .. {sizes.max(initial=0)}, got {count}"
            )
        if sizes.max() == count:
            return self
        number = np.arange(len(self)) - np.repeat(starts, sizes)
        return self.select(np.sort(order[number < count]))

    def select(self, samples: np.ndarray) -> ViewDataset:
        """The samples `samples`, int64 [B], and all objects. Arrays on disk are not read."""
        parts = {name: getattr(self, name) for name in (*_OF_VIEWS, "view_ids", "object_ids")}
        chosen = {
            name: part.select(samples) if hasattr(part, "select") else part[samples]
            for name, part in parts.items()
            if part is not None
        }
        return dataclasses.replace(self, **chosen)


# the corners of a cube of side 1 are 0.87 from its centre, at which the cameras look
DEPTH_REACH = 0.9


def depth_levels(depth: Tensor, poses: LookAtPoses) -> Tensor:
    """Quantise depth maps float [M, S, S]: 1 .. 255 near the centre's depth, 0 for no surface."""
    nearer = (depth - poses.distance[:, None, None]) / DEPTH_REACH
    level = (1 + 127 * (nearer + 1)).round().clamp(1, 255)
    return torch.where(nearer.abs() <= 1, level, 0).to(torch.uint8)


def depth_of_levels(levels: Tensor, poses: LookAtPoses) -> Tensor:
    """The inverse of `depth_levels`: float32 [M, S, S], 0 for no surface."""
    depth = ((levels.float() - 1) / 127 - 1) * DEPTH_REACH + poses.distance[:, None, None]
    return torch.where(levels > 0, depth, 0.0)


def concatenate(datasets: Sequence[ViewDataset]) -> ViewDataset:
    """Join categories of one layout and split to a set with class ids.

    ValueError if their view classes differ.
    """
    if len(datasets) == 1:
        return datasets[0]
    return dataclasses.replace(
        join_datasets(datasets),
        category=",".join(d.category for d in datasets),
        class_ids=np.repeat(np.arange(len(datasets)), [d.num_objects for d in datasets]),
        class_names=tuple(d.category for d in datasets),
    )


def join_datasets(datasets: Sequence[ViewDataset]) -> ViewDataset:
    """Concatenate the views and objects of several sets.

    Raises ValueError if their kinds of images or poses differ.
    """
    first = datasets[0]
    for other in datasets[1:]:
        if other.view_names != first.view_names:
            raise ValueError(
                f"{other.category} and {first.category} differ in view classes; give --view-bins (such as "
                "15x20) if cameras look at the object, else train a model of each category"
            )
    joined = {}
    for name in (*_OF_VIEWS, "view_ids", "voxels", "points"):
        parts = [getattr(d, name) for d in datasets]
        if len({type(part) for part in parts}) > 1:
            raise ValueError(
                f"{name} of different kinds cannot be joined: convert all categories to shards, or none"
            )
        if len({getattr(part, "shape", ())[1:] for part in parts}) > 1:
            sizes = " and ".join(str(list(part.shape[1:])) for part in parts)
            raise ValueError(f"{name} of different sizes cannot be joined: {sizes}")
        joined[name] = (
            None if parts[0] is None else getattr(parts[0], "join", np.concatenate)(parts)
        )
    starts = np.cumsum([0] + [d.num_objects for d in datasets])[:-1].tolist()
    return dataclasses.replace(
        first,
        **joined,
        object_ids=np.concatenate(
            [d.object_ids + start for d, start in zip(datasets, starts, strict=True)]
        ),
        object_names=tuple(name for d in datasets for name in d.object_names),
    )
