"""Gradients of a method's losses without a step of its optimizers."""

from learn3d.methods.method import Losses


def backpropagate(method, batch, step: int) -> Losses:
    """The losses of the step; their weighted sum is backpropagated."""
    losses = method.losses(batch, step)
    sum(weight * loss for weight, loss in losses.values()).backward()
    return losses
