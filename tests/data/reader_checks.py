"""Checks of what readers do: the problems they find, the memory they take."""

from __future__ import annotations

import contextlib
import threading
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import nmr
from learn3d.data.dataset import ViewDataset
from learn3d.data.layouts import Problem, check_folder, reader


def problems(layout: str, folder: Path, split: str, category: str = "chair") -> tuple[Problem, ...]:
    """Everything that `check-dataset` finds in a split."""
    (report,) = check_folder(layout, folder, [category], [split])
    return report.problems


def expect(layout: str, folder: Path, split: str, message: str, severity: str = "error") -> None:
    """The check must find this problem and no other; `load` must raise it, or read on if it is a warning."""
    (found,) = problems(layout, folder, split)
    assert found.severity == severity
    assert message in f"{found.path}: {found.message}"
    load = reader(layout).load
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
    drawn = nmr.render_silhouette(
        vertices, torch.from_numpy(faces), batch.cameras, image_size=64, anti_aliasing=True
    )
    return torch.minimum(drawn, batch.masks).sum((1, 2)) / torch.maximum(drawn, batch.masks).sum(
        (1, 2)
    )


def cut_short(path: Path) -> None:
    """Keep the first half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


_threads_at_start: set[threading.Thread] = set()  # of the tracing


@contextlib.contextmanager
def at_most(limit: int) -> Iterator[None]:
    """Fail if the block holds more than `limit` bytes at a time, beside what was held before.

    If the block leaves threads behind, tracing goes on until a later block finds them gone: Python 3.11 crashes when a
    thread allocates memory while tracing stops (python/cpython, issue 128679).
    """
    if not tracemalloc.is_tracing():
        _threads_at_start.clear()
        _threads_at_start.update(threading.enumerate())
        tracemalloc.start()
    tracemalloc.reset_peak()
    held = tracemalloc.get_traced_memory()[0]
    try:
        yield
    finally:  # after an error, too
        taken = tracemalloc.get_traced_memory()[1] - held
        if _threads_at_start.issuperset(threading.enumerate()):
            tracemalloc.stop()
        assert taken < limit, f"it took {taken} bytes, wanted less than {limit}"
