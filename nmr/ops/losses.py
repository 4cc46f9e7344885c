"""Operator: the soft intersection over union of pairs of images."""

import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, num_threads
from ._register import operator, register_autograd

# --- soft IoU


@operator
def soft_iou(prediction: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """``I / U`` of each pair of rows ``[B, N]`` with ``I = sum p t``, ``U = sum (p + t - p t)``: ``[B]``; 1 if U = 0.

    The second result is I and U, float64 ``[B, 2]``, for the gradient.
    """
    iou = host_empty(prediction.shape[0], dtype=prediction.dtype)
    areas = host_empty((prediction.shape[0], 2), dtype=torch.float64)
    _C.soft_iou_forward(host_array(prediction), host_array(target), areas.numpy(), iou.numpy(), num_threads())
    return iou.to(prediction.device), areas.to(prediction.device)


@torch.library.register_fake(soft_iou.op)
def _(prediction, target):
    batch = prediction.shape[0]
    return prediction.new_empty(batch), prediction.new_empty((batch, 2), dtype=torch.float64)


def _soft_iou_setup(ctx, inputs, output):
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs, output[1])


def _soft_iou_backward(ctx, grad_iou, _grad_areas):
    of_prediction, of_target = ctx.needs_input_grad
    if grad_iou is None:
        return None, None
    grads = soft_iou_backward(*ctx.saved_tensors, grad_iou, of_prediction, of_target)
    return grads[0] if of_prediction else None, grads[1] if of_target else None


register_autograd(soft_iou, _soft_iou_backward, _soft_iou_setup)


@operator
def soft_iou_backward(
    prediction: Tensor,
    target: Tensor,
    areas: Tensor,
    grad_iou: Tensor,
    of_prediction: bool,
    of_target: bool,
) -> tuple[Tensor, Tensor]:
    """Gradients of :func:`soft_iou` in prediction and target; 0 if U = 0. One that is not requested is empty."""
    wanted = (prediction, of_prediction), (target, of_target)
    grads = [host_empty(x.shape if want else 0, dtype=x.dtype) for x, want in wanted]
    arrays = map(host_array, (prediction, target, areas, grad_iou))
    _C.soft_iou_backward(
        *arrays, *(g.numpy() if want else None for g, (_, want) in zip(grads, wanted, strict=True)), num_threads()
    )
    return tuple(grad.to(prediction.device) for grad in grads)


@torch.library.register_fake(soft_iou_backward.op)
def _(prediction, target, areas, grad_iou, of_prediction, of_target):
    return (
        prediction.new_empty(prediction.shape if of_prediction else 0),
        target.new_empty(target.shape if of_target else 0),
    )


def _gradient(prediction, target, grad_iou):
    """The same in torch, for second derivatives."""
    both = (prediction * target).sum(1, keepdim=True)
    either = (prediction + target).sum(1, keepdim=True) - both
    empty = either == 0
    scale = torch.where(empty, 0.0, grad_iou.unsqueeze(1)) / torch.where(empty, 1.0, either).square()
    return tuple((other * (either + both) - both) * scale for other in (target, prediction))


def _soft_iou_second_setup(ctx, inputs, output):
    prediction, target, _, grad_iou, *ctx.wanted = inputs
    ctx.save_for_backward(prediction, target, grad_iou)


def _soft_iou_second_backward(ctx, *grads):
    def gradient(*inputs):
        return tuple(x for x, want in zip(_gradient(*inputs), ctx.wanted, strict=True) if want)

    _, pull = torch.func.vjp(gradient, *ctx.saved_tensors)
    of_prediction, of_target, of_iou = pull(tuple(x for x, want in zip(grads, ctx.wanted, strict=True) if want))
    return of_prediction, of_target, None, of_iou, None, None


register_autograd(soft_iou_backward, _soft_iou_second_backward, _soft_iou_second_setup)
