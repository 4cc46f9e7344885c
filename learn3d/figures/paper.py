"""The paper's figures, each from opened runs into files; what `learn3d figures` calls."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch

from learn3d.config import load_config
from learn3d.data.conventions import Definition
from learn3d.evaluation import spread_samples
from learn3d.figures import codes, curves, plots, polar
from learn3d.figures.grids import comparison_grid, spread_views
from learn3d.figures.interpolation import interpolation_strip, morph, typical_views
from learn3d.figures.runs import Run, by_dataset, encode, name_runs, title_of
from learn3d.files import writing
from learn3d.pictures.sheets import save_gif, save_png, stack, tile, with_suffix
from learn3d.pictures.surfaces import azimuths_deg

IMAGES = 6  # rows of a grid of one category
IMAGES_PER_CATEGORY = 2  # rows of each of several categories
TILE_SIZE = 128  # pixels
FRAMES = 16  # of the morph from one image to the next
MORPH_SIZE = 192  # pixels
MOST_CODES = 2000  # images whose codes are laid out


def save_grid(
    runs: Sequence[Run],
    output: Path,
    *,
    images: int | None = None,
    indices: Sequence[int] = (),
    truth: bool = False,
) -> Path:
    """Reconstructions of test images, runs beside each other, categories below each other, as a PNG.

    images: how many of each category, chosen by `spread_views`; None: 6, or 2 of each of several categories. indices:
    samples to show instead, of every category. truth: show the true voxels, too.
    """
    groups, blocks = by_dataset(runs), []
    count = images if images is not None else IMAGES if len(groups) == 1 else IMAGES_PER_CATEGORY
    for group in groups:
        dataset = group[0].dataset
        samples = torch.tensor(indices) if indices else spread_views(dataset, min(count, len(dataset)))
        title = dataset.category if len(groups) > 1 else ""
        methods = [(run.label, run.method) for run in group]
        blocks.append(comparison_grid(methods, dataset, samples, truth=truth, title=title, tile_size=TILE_SIZE))
    path = with_suffix(_in_folder(output), ".png")
    save_png(path, stack(blocks, gap=10))
    return path


def save_tsne(runs: Sequence[Run], output: Path) -> list[Path]:
    """Shape codes of test images in the plane, coloured by the view, a map per run, as PNG and SVG."""
    maps = []
    for run in runs:
        dataset = run.dataset
        samples = spread_samples(dataset.object_ids, dataset.view_ids, min(MOST_CODES, len(dataset)))
        shape_codes, azimuths = encode(run.method, dataset, samples).numpy(), azimuths_deg(dataset.poses)[samples]
        rows = samples.numpy()
        ids = (dataset.view_ids[rows], dataset.object_ids[rows])
        maps.append(codes.map_codes(title_of(run, runs), shape_codes, azimuths.numpy(), *ids))
    return plots.save_figure(codes.plot_maps(maps), _in_folder(output))


def save_interpolation(
    runs: Sequence[Run], output: Path, *, images: int = 3, indices: Sequence[int] = (), steps: int = 4
) -> list[Path]:
    """Shapes between those of some test images: a strip per run as PNG, and an endless morph as GIF.

    images: how many, chosen by `typical_views` with the first run of each category; indices: samples to use instead.
    steps: shapes from one image to the next in the strip.
    """
    strips, morphs, titles = [], [], []
    for group in by_dataset(runs):
        first = group[0]
        samples = torch.tensor(indices) if indices else typical_views(first.method, first.dataset, images)
        for run in group:
            titles.append(title_of(run, runs) if len(runs) > 1 else "")
            strips.append(interpolation_strip(run.method, run.dataset, samples, steps=steps, title=titles[-1]))
            morphs.append(morph(run.method, run.dataset, samples, steps=FRAMES, image_size=MORPH_SIZE))
    frames = [tile(rows, tile_size=MORPH_SIZE, row_titles=titles) for rows in zip(*morphs, strict=True)]
    paths = [with_suffix(_in_folder(output), suffix) for suffix in (".png", ".gif")]
    save_png(paths[0], stack(strips, gap=10))
    save_gif(paths[1], np.stack(frames))
    return paths


def save_curves(paths: Sequence[Path], output: Path, *, labels: Sequence[str] = ()) -> list[Path]:
    """Learning curves of run folders as PNG and SVG; runs that differ in their seed alone are one line with a band."""
    if not paths:
        raise ValueError("give at least one run folder to draw")
    logs = [curves.read_metrics(path) for path in paths]
    configs = [load_config(Path(path) / "config.json") for path in paths] if not labels else []
    names = name_runs(configs, paths, labels, seeds_apart=False)
    if len({config.category for config in configs}) > 1:
        names = [f"{config.category}: {name}" for config, name in zip(configs, names, strict=True)]
    lines: dict[str, list[dict[curves.Key, curves.Curve]]] = {}
    for name, log in zip(names, logs, strict=True):
        lines.setdefault(name, []).append(log)
    return plots.save_figure(curves.plot_curves(lines), _in_folder(output))


def save_polar(runs: Sequence[Run], output: Path, *, definition: Definition = "kato18") -> list[Path]:
    """IoU by the azimuth of the input view as PNG and SVG, and the figures in it as JSON."""
    profiles = [polar.measure(title_of(run, runs), run.method, run.dataset, definition) for run in runs]
    path = with_suffix(_in_folder(output), ".json")
    writing.write_json(path, {"voxels": definition, "profiles": [p.to_json() for p in profiles]})
    return [*plots.save_figure(polar.plot_profiles(profiles), output), path]


def save_all(
    runs: Sequence[Run],
    paths: Sequence[Path],
    folder: Path,
    *,
    labels: Sequence[str] = (),
    without: Mapping[str, str] = MappingProxyType({}),
    say: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Every figure with its defaults, into files of these names in `folder`; returns the files that were written.

    runs: `paths`, opened. without: figures to leave out, and why. What cannot be drawn is said, with the reason.
    """
    for name, reason in without.items():
        say(f"not drawn: {name}: {reason}")
    figures: dict[str, Callable[[Path], list[Path]]] = {
        "grid": lambda path: [save_grid(runs, path)],
        "tsne": lambda path: save_tsne(runs, path),
        "interpolation": lambda path: save_interpolation(runs, path),
        "curves": lambda path: save_curves(paths, path, labels=labels),
        "polar": lambda path: save_polar(runs, path),
    }
    written = []
    for name in [name for name in figures if name not in without]:
        say(f"drawing {name}")
        try:
            written += figures[name](Path(folder) / name)
        except (ValueError, OSError) as error:
            say(f"not drawn: {name}: {error}")
    return written


def _in_folder(output: Path) -> Path:
    """The path, its folder made."""
    output = Path(output)
    output.parent.mkdir(parents=True, exist_ok=True)
    return output
