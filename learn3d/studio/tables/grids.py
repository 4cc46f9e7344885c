"""Pictures of shapes in rows: the comparison of runs, and interpolations."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from learn3d.data.dataset import ViewDataset
from learn3d.evaluation import AROUND, TURNS_DEG, spread_samples
from learn3d.pictures import (
    TILE,
    Cameras,
    Surface,
    azimuths_deg,
    draw_surface,
    grid_surface,
    natural_colors,
    orbit,
    save_png,
    tile,
)
from learn3d.studio.tables.trained_models import TrainedModel

TILE_SIZE = 128  # pixels of a picture in a comparison
# Views of an interpolation: oblique, along whichever axis the objects face.
AZIMUTHS_DEG = (-135.0, -45.0)
STEPS = 4  # steps of an interpolation from one image to the next


@torch.no_grad()
def comparison_grid(
    runs: Sequence[TrainedModel], samples: Tensor, *, truth: bool = False, title: str = "input"
) -> np.ndarray:
    """Reconstructions of the same images by runs on one data set: uint8 [H,W,3].

    A group of rows per image: the input, and a row per run with its shape from the input's view
    and from five more around the object. `title` is above the inputs. All pictures are magnified
    by the same factor, as far as the shapes allow. With `truth` the first row of a group has the
    true voxels; raises ValueError if there are none.
    """
    dataset = runs[0].dataset
    batch = dataset.batch(samples)
    shown = [
        (run.label, run.method.decode(run.method.encode(batch.images)).surfaces()) for run in runs
    ]
    if truth:
        if dataset.voxels is None:
            raise ValueError(f"{dataset.category}, {dataset.split} has no true voxels to show")
        voxels = dataset.convention.to_object(batch.voxels.float())
        shown.insert(
            0, ("truth", [grid_surface(grid, box=dataset.convention.cube_side) for grid in voxels])
        )
    poses = [dataset.poses[sample[None]] for sample in samples]
    cameras = [orbit(pose, TURNS_DEG) for pose in poses]
    zoom = common_zoom(
        [pair for _, shapes in shown for pair in zip(shapes, cameras, strict=True)], batch.masks
    )
    inputs = magnify(natural_colors(batch.images.numpy(), inverted=dataset.inverted), zoom)
    rows = []
    for i, pose in enumerate(poses):
        zoomed = orbit(pose, TURNS_DEG, zoom=zoom)
        pictures = [draw_surface(shapes[i], zoomed, image_size=TILE_SIZE) for _, shapes in shown]
        rows += [[inputs[i] if k == 0 else None, *row] for k, row in enumerate(pictures)]
    labels = [label for label, _ in shown] * len(samples)
    rules = range(len(shown), len(rows), len(shown))
    return tile(
        rows, [title, "input view", *AROUND], tile_size=TILE_SIZE, row_titles=labels, rules=rules
    )


@torch.no_grad()
def interpolate(run: TrainedModel, samples: Tensor, *, title: str = "input") -> np.ndarray:
    """Shapes between a run's reconstructions of images, samples int64 [n]: uint8 [H,W,3].

    The first row has the images, each above its reconstruction, and `title` before them. Below it
    are a row per view of (n - 1) * STEPS + 1 shapes, whose codes are interpolated linearly.
    Raises ValueError for fewer than two images.
    """
    if len(samples) < 2:
        raise ValueError(f"an interpolation takes at least two images, got {len(samples)}")
    dataset = run.dataset
    method = run.method
    batch = dataset.batch(samples)
    pose = dataset.poses[samples[:1]]
    codes = method.encode(batch.images)
    weights = torch.arange(STEPS, dtype=codes.dtype, device=codes.device)[:, None] / STEPS
    between = torch.lerp(codes[:-1, None], codes[1:, None], weights).flatten(0, 1)
    shapes = method.decode(torch.cat([between, codes[-1:]])).surfaces()
    turns = [azimuth - float(azimuths_deg(pose)[0]) for azimuth in AZIMUTHS_DEG]
    cameras = orbit(pose, turns)
    zoom = common_zoom([(surface, cameras) for surface in shapes], batch.masks)
    cameras = orbit(pose, turns, zoom=zoom)
    pictures = np.stack([draw_surface(surface, cameras, image_size=TILE) for surface in shapes])
    inputs: list[np.ndarray | None] = [None] * len(shapes)
    inputs[::STEPS] = magnify(natural_colors(batch.images.numpy(), inverted=dataset.inverted), zoom)
    titles = [title, *(f"azimuth {azimuth:g}°" for azimuth in AZIMUTHS_DEG)]
    return tile([inputs, *pictures.swapaxes(0, 1)], row_titles=titles)


def save_grid(
    runs: Sequence[TrainedModel],
    output: Path,
    *,
    images: int = 6,
    indices: Sequence[int] = (),
    truth: bool = False,
) -> list[Path]:
    """Save a `comparison_grid` for each data set, below each other, as a PNG.

    images, indices: the samples of each data set, see `choose_samples`.
    """
    blocks = []
    datasets = {id(run.dataset): run.dataset for run in runs}.values()
    for dataset in datasets:
        group = [run for run in runs if run.dataset is dataset]
        samples = choose_samples(dataset, images, indices)
        title = dataset.category if len(datasets) > 1 else "input"
        blocks.append(comparison_grid(group, samples, truth=truth, title=title))
    return _save(blocks, output)


def save_interpolation(
    runs: Sequence[TrainedModel], output: Path, *, images: int = 3, indices: Sequence[int] = ()
) -> list[Path]:
    """Save the interpolation of each run, below each other, as a PNG. images, indices: see `choose_samples`."""
    samples = [choose_samples(run.dataset, images, indices) for run in runs]
    titles = [run.label for run in runs] if len(runs) > 1 else ["input"]
    return _save(
        [
            interpolate(*each, title=title)
            for *each, title in zip(runs, samples, titles, strict=True)
        ],
        output,
    )


def choose_samples(dataset: ViewDataset, count: int, indices: Sequence[int] = ()) -> Tensor:
    """The samples `indices`, int64; without them `count` samples, of different objects and views if possible.

    Raises ValueError if the data set has fewer.
    """
    if indices:
        return torch.tensor(indices)
    if not 1 <= count <= len(dataset):
        raise ValueError(f"the data set has {len(dataset)} images, {count} were asked for")
    return spread_samples(dataset.object_ids, dataset.view_ids, count)


def _save(blocks: Sequence[np.ndarray], output: Path) -> list[Path]:
    """Save pictures uint8 [h,w,3] below each other, flush left, ten white rows apart."""
    width = max(block.shape[1] for block in blocks)
    padded = [
        np.pad(b, ((0, 10), (0, width - b.shape[1]), (0, 0)), constant_values=255) for b in blocks
    ]
    output.parent.mkdir(parents=True, exist_ok=True)
    save_png(path := output.with_suffix(".png"), np.concatenate(padded)[:-10])
    return [path]


def magnify(pictures: np.ndarray, zoom: float) -> np.ndarray:
    """The central part of pictures uint8 [N,h,w,3]: a share 1 / zoom of each side, in fewer pixels."""
    height, width = pictures.shape[1:3]
    top, left = (round(side * (1 - 1 / zoom) / 2) for side in (height, width))
    return pictures[:, top : height - top, left : width - left]


def common_zoom(shapes: Iterable[tuple[Surface, Cameras]], masks: Tensor) -> float:
    """The largest magnification, at least 1, at which shapes and masks stay inside their pictures.

    masks: float [B, S, S] of the input images. A mask that touches the border allows no
    magnification.
    """
    inside = torch.nonzero(masks > 0.5)[:, 1:]
    # 1 is the border
    farthest = [
        0.05,
        *((2 * inside + 1) / masks.shape[-1] - 1).abs().flatten().tolist(),
    ]
    for surface, cameras in shapes:
        corners = surface.vertices[surface.faces.unique()][None]
        farthest += [
            float(camera.transform(corners)[..., :2].abs().max())
            for camera in cameras
            if corners.numel()
        ]
    return max(1.0, 0.95 / max(farthest))
