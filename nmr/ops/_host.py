"""Shared by all operators: NumPy views of tensors, batch sizes, and the error for second derivatives."""

import torch
from torch import Tensor

try:
    from .. import _C
except ImportError as error:
    raise ImportError(
        "the compiled part of nmr is missing: Python imports the source folder, or the installation failed; "
        "run `pip install .` in the repository and start Python in another folder, or use `pip install -e .`"
    ) from error

__all__ = ["_C", "batch_size", "host_array", "host_empty", "no_second_derivative", "num_threads"]


def host_array(tensor):
    """The tensor as a C-contiguous NumPy array in host memory (a view on the CPU); None stays None."""
    return None if tensor is None else tensor.contiguous().numpy(force=True)


def host_empty(shape, dtype) -> Tensor:
    """A new tensor in host memory, whatever the default device is."""
    return torch.empty(shape, dtype=dtype, device="cpu")


def num_threads() -> int:
    return torch.get_num_threads()


def batch_size(vertices: Tensor, starts) -> int:
    """B of vertices ``[B, V, 3]``, or of packed vertices ``[N, 3]`` with starts ``[B + 1, 2]``."""
    return vertices.shape[0] if starts is None else starts.shape[0] - 1


def no_second_derivative(name: str):
    """Backward pass of operators that compute gradients: a RuntimeError that names the public function."""

    def backward(ctx, *grads):
        raise RuntimeError(
            f"{name} has no second derivative: its gradient is computed by a kernel that is not differentiable; "
            "call backward() without create_graph=True"
        )

    return backward
