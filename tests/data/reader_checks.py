"""Questions that the tests of every reader ask: checking and loading must tell of the same faults."""

from pathlib import Path

import numpy as np
import pytest
import torch

import nmr
from learn3d.data.checking import check_folder
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers import READERS
from learn3d.files.reading import Problem


def problems(layout: str, folder: Path, split: str, category: str = "chair") -> tuple[Problem, ...]:
    """Everything that `check-dataset` finds in a split."""
    (report,) = check_folder(layout, folder, [category], [split]).splits
    return report.problems


def expect(layout: str, folder: Path, split: str, message: str, severity: str = "error") -> None:
    """The check must find this problem and no other; `load` must raise it, or read on if it is a warning."""
    (found,) = problems(layout, folder, split)
    assert found.severity == severity
    assert message in f"{found.path}: {found.message}"
    load = READERS[layout].load
    if severity == "warning":
        load(folder, "chair", split)
        return
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        load(folder, "chair", split)
    assert message in str(error.value)


def silhouette_iou(dataset: ViewDataset, vertices: np.ndarray, faces: np.ndarray) -> torch.Tensor:
    """IoU [M] of the data set's masks and of a mesh in the object frame, drawn by nmr with the data set's cameras."""
    batch = dataset.batch(torch.arange(len(dataset)))
    vertices = torch.from_numpy(vertices).float().expand(len(dataset), -1, -1)
    drawn = nmr.render_silhouette(vertices, torch.from_numpy(faces), batch.cameras, image_size=64, anti_aliasing=True)
    return torch.minimum(drawn, batch.masks).sum((1, 2)) / torch.maximum(drawn, batch.masks).sum((1, 2))


def cut_short(path: Path) -> None:
    """Keep the first half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
