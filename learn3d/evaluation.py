"""Voxel IoU and pose invariance (MMD) of trained networks on one split of a data set."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import itertools
import math
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

import nmr
from learn3d import checkpoint
from learn3d.data.kato import KatoDataset
from learn3d.losses import mmd_from_distances
from learn3d.networks import Networks, autocast, network_input

CODES_PER_VIEW = 512


@dataclass(frozen=True)
class Evaluation:
    """Result for one class. `mmd` and `mmd_paper` are None when fewer than two views have codes."""

    voxel_iou: float | None  # None when it is defined for no image
    mmd: float | None
    mmd_paper: float | None
    images: int
    undefined: int  # images whose prediction and truth are both empty; excluded from the mean


@torch.no_grad()
def evaluate(
    networks: Networks,
    dataset: KatoDataset,
    *,
    precision: Literal["bf16", "fp32"] = "fp32",
    max_images: int | None = None,
    paper_mmd: bool = False,
    batch_size: int = 256,
) -> Evaluation:
    """Mean voxel IoU over the images of a split, and the mean MMD over all pairs of views.

    Every image (object x view) is encoded, its mesh voxelised in the data set's convention and compared with the
    object's voxels. With `max_images` only that many images are used, always the same ones: see `spread_samples`.
    `paper_mmd` also computes the MMD as the paper prints it.
    """
    count = len(dataset) if max_images is None else min(max_images, len(dataset))
    indices = spread_samples(dataset.num_objects, dataset.num_views, count)
    ious, codes, views = [], [], []
    for chosen in indices.split(batch_size):
        batch = dataset.batch(chosen)
        with autocast(networks.device, precision):
            code = networks.encoder(network_input(batch.images, networks.device))
            vertices = networks.generator(code)
        predicted = dataset.voxelize(vertices.cpu(), networks.generator.faces.cpu())
        ious.append(nmr.metrics.voxel_iou(predicted, batch.voxels))
        codes.append(code.float().cpu())
        views.append(batch.view_ids)
    iou = torch.cat(ious)
    undefined = int(iou.isnan().sum())
    forms = ("released", "paper") if paper_mmd else ("released",)
    means = mean_mmd(torch.cat(codes), torch.cat(views), forms=forms)
    return Evaluation(
        voxel_iou=float(iou.nanmean()) if undefined < count else None,
        mmd=means.get("released"),
        mmd_paper=means.get("paper"),
        images=count,
        undefined=undefined,
    )


def spread_samples(num_objects: int, num_views: int, count: int) -> Tensor:
    """`count` different samples object * num_views + view, int64 [count], ascending; a function of its arguments alone.

    Every view is among them as often as any other, give or take one, and so is every object. Going through the views
    and through the objects side by side meets each pair once in lcm(objects, views) steps; then the objects shift by
    one. Both orders are shuffled, so that it is not always the same view that goes with an object.
    """
    generator = torch.Generator().manual_seed(0)
    objects, views = (torch.randperm(n, generator=generator) for n in (num_objects, num_views))
    k = torch.arange(count)
    turn = k // math.lcm(num_objects, num_views)
    return (objects[(k + turn) % num_objects] * num_views + views[k % num_views]).sort().values


def mean_mmd(
    codes: Tensor,
    view_ids: Tensor,
    *,
    per_view: int = CODES_PER_VIEW,
    forms: tuple[Literal["released", "paper"], ...] = ("released",),
) -> dict[str, float]:
    """Mean MMD over all pairs of views (276 for 24) between the codes [N,C] of their images; {} for a single view.

    Of each view the first `per_view` codes count; all views use as many as the poorest one has. Distances within a view
    are computed once, not once per pair.
    """
    groups = [codes[view_ids == view] for view in view_ids.unique()]
    if len(groups) < 2:
        return {}
    size = min(per_view, *(len(group) for group in groups))
    groups = [group[:size].double() for group in groups]
    norms = [group.square().sum(1) for group in groups]

    def distances(i: int, j: int) -> Tensor:
        squared = torch.addmm(norms[j].expand(size, size), groups[i], groups[j].T, alpha=-2)
        return (squared + norms[i][:, None]).clamp_min_(0).float()

    within = [distances(i, i) for i in range(len(groups))]
    sums = dict.fromkeys(forms, 0.0)
    pairs = list(itertools.combinations(range(len(groups)), 2))
    for i, j in pairs:
        between = distances(i, j)
        for form in forms:
            sums[form] += float(mmd_from_distances(within[i], within[j], between, form))
    return {form: value / len(pairs) for form, value in sums.items()}


def evaluate_runs(
    paths: Sequence[Path],
    *,
    data: Path | None = None,
    category: str | None = None,
    split: str = "test",
    which: Literal["last", "best"] = "last",
    precision: Literal["bf16", "fp32"] = "fp32",
    device: str = "cpu",
    report_progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Evaluate run folders or checkpoint files on a split; a report ready for JSON, see `format_table`.

    `data` and `category` default to those each run was trained with. The mean over classes is taken per method; several
    runs of one class and method (seeds) count as one class.
    """
    if not paths:
        raise ValueError("give at least one run folder or checkpoint to evaluate")
    results = []
    for path in paths:
        file = checkpoint.find(path, which)
        networks, config, metadata = checkpoint.load_networks(file, device=device)
        name, folder = category or config.category, data or config.data
        report_progress(f"{file}: {config.method} on {name}, {split}")
        result = evaluate(networks, KatoDataset.load(folder, name, split), precision=precision, paper_mmd=True)
        if result.undefined:
            report_progress(f"warning: {result.undefined} images have no IoU (prediction and truth empty); left out")
        about = {
            "checkpoint": str(file),
            "category": name,
            "data": str(folder),
            "method": config.method,
            "preset": config.preset,
            "iterations": metadata["step"],
            "seed": config.seed,
        }
        results.append(about | dataclasses.asdict(result))
    protocol = {
        "split": split,
        "checkpoint": which,
        "precision": precision,
        "views": "all views of all objects, each image on its own",
        "voxels": "32^3, filled surface voxels (kato18), mean over images, then over classes",
        "mmd": f"mean over all pairs of views, up to {CODES_PER_VIEW} codes each; five kernels, no root",
        "mmd_paper": "the same with the paper's printed formula: one kernel, square root",
    }
    return {"protocol": protocol, "versions": versions(), "results": results, "means": _class_means(results)}


def format_table(report: dict[str, Any]) -> str:
    """The report of `evaluate_runs` as a text table: a line per run, then a mean over classes per method."""
    header = ("class", "method", "seed", "iterations", "images", "voxel IoU", "MMD", "MMD (printed formula)")
    rows = [header]
    for r in report["results"]:
        label = f"{r['method']} ({r['preset']})"
        counts = (str(r["seed"]), str(r["iterations"]), str(r["images"]))
        rows.append((r["category"], label, *counts, *(_number(r[k]) for k in ("voxel_iou", "mmd", "mmd_paper"))))
    for m in report["means"]:
        label, classes = f"{m['method']} ({m['preset']})", f"{m['classes']} classes" if m["classes"] > 1 else "1 class"
        rows.append(("mean", label, "", "", classes, *(_number(m[k]) for k in ("voxel_iou", "mmd", "mmd_paper"))))
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(lines)


def versions() -> dict[str, str | None]:
    """Versions of the package and of torch, and the git commit when the code runs from a checkout."""
    try:
        package = importlib.metadata.version("nmr-learn3d")
    except importlib.metadata.PackageNotFoundError:
        package = None
    return {"nmr-learn3d": package, "torch": torch.__version__, "commit": _git_commit()}


def _class_means(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean over classes of each method's figures; runs of the same class are averaged first."""
    methods = dict.fromkeys((r["method"], r["preset"]) for r in results)
    means = []
    for method, preset in methods:
        mine = [r for r in results if (r["method"], r["preset"]) == (method, preset)]
        classes = sorted({r["category"] for r in mine})
        row: dict[str, Any] = {"method": method, "preset": preset, "classes": len(classes)}
        for key in ("voxel_iou", "mmd", "mmd_paper"):
            per_class = [_mean([r[key] for r in mine if r["category"] == name]) for name in classes]
            row[key] = _mean(per_class)
        means.append(row)
    return means


def _mean(values: list[float | None]) -> float | None:
    """Plain mean, or None when a value is missing."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _git_commit() -> str | None:
    """Commit of the checkout that holds this file (with "-dirty" after changes), None for an installed copy."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("rev-parse", "HEAD") + ("-dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
