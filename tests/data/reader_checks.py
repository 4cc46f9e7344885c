"""What the tests of every reader ask of it: `problems` and `load` must tell of the same faults."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import nmr
from learn3d.data.dataset import ViewDataset


def expect(reader: ModuleType, folder: Path, split: str, message: str, severity: str = "error") -> None:
    """The scan must find this problem and no other; `load` must raise it, or read on if it is a warning."""
    found = list(reader.problems(folder, "chair", split))
    assert [p.severity for p in found] == [severity], found
    assert message in f"{found[0].path}: {found[0].message}"
    if severity == "warning":
        reader.load(folder, "chair", split)
        return
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        reader.load(folder, "chair", split)
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
