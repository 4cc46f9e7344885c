"""Copies between the CPU and a GPU: the identity on the CPU, in order and with gradients elsewhere."""

from __future__ import annotations

import pytest
import torch

from learn3d import device
from learn3d.device import Download, upload
from learn3d.methods.optimization import backpropagate, read_back

CPU = torch.device("cpu")
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def test_on_the_cpu_there_is_nothing_to_copy() -> None:
    x = torch.randn(3, requires_grad=True)
    assert upload(x, CPU) is x
    assert Download(x).wait() is x
    assert Download(x).finish().data_ptr() == x.data_ptr()


class Copies:
    """Stands in for a GPU: copies are clones, and one may only be read after it was waited for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.log: list[str] = []
        monkeypatch.setattr(device, "_start_copy", self.start)
        monkeypatch.setattr(device, "_send", self.send)

    def start(self, tensor: torch.Tensor) -> tuple[torch.Tensor, Copies]:
        self.log.append("start")
        return tensor.clone(), self

    def synchronize(self) -> None:
        self.log.append("wait")

    def send(self, tensor: torch.Tensor, device: torch.device) -> torch.Tensor:
        self.log.append(f"send to {device}")
        return tensor.detach().clone()


def test_a_download_is_waited_for_when_needed_and_sends_its_gradient_back(monkeypatch: pytest.MonkeyPatch) -> None:
    copies = Copies(monkeypatch)
    x = torch.tensor([1.0, 2.0], requires_grad=True)
    download = Download(2 * x)
    assert copies.log == ["start"]
    here = download.wait()
    assert copies.log == ["start", "wait"]
    here.square().sum().backward()
    assert copies.log == ["start", "wait", "send to cpu"]
    assert x.grad.tolist() == [8.0, 16.0]


def test_the_gradient_of_an_upload_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    copies = Copies(monkeypatch)
    x = torch.tensor([1.0, 2.0], requires_grad=True)
    there = device._Uploaded.apply(x, torch.device("cuda"))
    there.square().sum().backward()
    assert copies.log == ["send to cuda", "start", "wait"]
    assert x.grad.tolist() == [2.0, 4.0]


def test_losses_are_weighted_added_up_and_returned_in_their_order() -> None:
    x = torch.tensor(3.0, requires_grad=True)
    values = backpropagate({"b": x.square(), "a": 2 * x, "c": -x}, {"a": 0.5, "b": 1.0, "c": 0.0}, step=1)
    assert list(values.items()) == [("b", 9.0), ("a", 6.0), ("c", -3.0), ("total", 12.0)]
    assert x.grad == 7.0


@pytest.mark.parametrize("name", ["projection", "prior"])
def test_a_loss_that_is_not_finite_stops_before_any_gradient(name: str) -> None:
    x = torch.tensor(1.0, requires_grad=True)
    losses = {"projection": x, "prior": x, name: x * torch.inf}
    with pytest.raises(FloatingPointError, match=rf"iteration 7 .*{name} inf"):
        backpropagate(losses, {"projection": 1.0, "prior": 1e-3}, step=7)
    assert x.grad is None


def test_a_loss_without_a_weight_is_an_error() -> None:
    with pytest.raises(ValueError, match="lack norm; they have nrom"):
        backpropagate({"norm": torch.tensor(1.0)}, {"nrom": 0.1}, step=1)


def test_one_copy_reads_all_losses_of_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    copies = Copies(monkeypatch)
    losses = {"a": torch.tensor(1.0), "b": torch.tensor(2.0, dtype=torch.bfloat16), "c": torch.tensor(3.0)}
    assert read_back(losses) == {"a": 1.0, "b": 2.0, "c": 3.0}
    assert copies.log == ["start", "wait"]


@needs_cuda
def test_there_and_back_on_a_gpu() -> None:
    device = torch.device("cuda")
    x = torch.randn(1000, 3, requires_grad=True)
    there = upload(x, device)
    back = Download(2 * there).wait()
    assert there.device.type == "cuda"
    assert back.device.type == "cpu"
    assert torch.equal(back, 2 * x)
    back.square().sum().backward()
    torch.testing.assert_close(x.grad, 8 * x.detach())


@needs_cuda
def test_losses_on_both_sides_on_a_gpu() -> None:
    x = torch.tensor(3.0, device="cuda", requires_grad=True)
    values = backpropagate({"far": x.square(), "near": Download(x).wait() * 2}, {"near": 0.5, "far": 1.0}, step=1)
    assert values == {"far": 9.0, "near": 6.0, "total": 12.0}
    assert x.grad == 7.0
