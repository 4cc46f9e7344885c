"""Training, resumption and evaluation with the networks on a GPU."""

from __future__ import annotations

import pytest
import torch

from learn3d.runs import checkpoint
from learn3d.runs.measurement import evaluate_runs
from learn3d.training import train

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_train_resume_and_evaluate(precision: str, tiny_config, run_folder, read_metrics) -> None:
    train(tiny_config(run_folder, device="cuda", precision=precision, iterations=2))
    summary = train(tiny_config(run_folder, device="cuda", precision=precision), resume=True)
    assert (summary.progress.step, summary.finished) == (4, True)
    metrics = read_metrics(run_folder)
    assert [m["step"] for m in metrics if m["split"] == "train"] == [1, 2, 3, 4]
    assert [m["step"] for m in metrics if m["split"] == "val"] == [2, 4]
    tensors, _ = checkpoint.load(run_folder / "last.safetensors")
    assert "random.cuda" in tensors
    on_gpu, on_cpu = (
        next(evaluate_runs([run_folder], split="test", device=device)).voxel_iou
        for device in ("cuda", "cpu")
    )
    assert on_gpu == pytest.approx(on_cpu, abs=0.02)


def test_plus_compares_masks_of_novel_views(tiny_config, run_folder, read_metrics) -> None:
    train(tiny_config(run_folder, preset="plus-kato", device="cuda", bank_size=4))
    assert all(m["novel_view"] > 0 for m in read_metrics(run_folder) if m["split"] == "train")


def test_first_losses_are_those_of_the_cpu(
    tiny_config, finished_run, run_folder, read_metrics
) -> None:
    train(tiny_config(run_folder, device="cuda", iterations=1))
    (ours, *_), (theirs, *_) = read_metrics(run_folder), read_metrics(finished_run)
    for name in ("projection", "smoothness", "classification", "prior"):
        assert ours[name] == pytest.approx(theirs[name], rel=1e-2), name
