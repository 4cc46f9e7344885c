"""How the operators are registered: ``@operator`` for the kernel, ``register_autograd`` for its gradient.

This is what ``torch.library.custom_op`` does, except for three things: the first call does not import torch._dynamo
(one second); operators work inside ``torch.func.grad``, ``vjp`` and ``jacrev``; forward-mode derivatives raise an
error (there, they are 0 without a word).
"""

from __future__ import annotations

import inspect
from typing import Optional, get_args, get_origin, get_type_hints

import torch
from torch import Tensor
from torch.autograd import forward_ad

_LIBRARY = torch.library.Library("nmr", "FRAGMENT")
# In torch's schema language. Optional[Tensor] is equal to Tensor | None. Lists of tensors would have no gradient.
_TYPES = {
    Tensor: "Tensor",
    Optional[Tensor]: "Tensor?",  # noqa: UP045
    bool: "bool",
    int: "SymInt",
    float: "float",
    list[bool]: "bool[]",
    list[int]: "SymInt[]",
}


def operator(kernel):
    """Registers a function of plain tensors as the operator ``nmr::<its name>`` on all devices, and returns that.

    Its arguments and results need types, and have no default values (torch would leave out arguments equal to them).
    The results are new tensors. Inside ``torch.func.vmap`` the operator is called once per item.
    """
    name, hints = kernel.__name__, get_type_hints(kernel)
    parameters = inspect.signature(kernel).parameters.values()
    assert all(p.default is p.empty for p in parameters), f"{name}: arguments of operators have no default values"
    arguments = ", ".join(f"{_schema_type(hints[p.name])} {p.name}" for p in parameters)
    schema = f"{name}({arguments}) -> {_schema_type(hints['return'])}"
    _LIBRARY.define(schema, tags=(torch.Tag.pt2_compliant_tag,))
    _LIBRARY.impl(name, kernel, "CompositeExplicitAutograd")
    op = getattr(torch.ops.nmr, name).default
    if hasattr(torch.library, "register_vmap"):  # torch < 2.5 loops, too, but warns that it is slow

        def one_by_one(info, in_dims, *args):
            def item(i):
                return (x if d is None else x.select(d, i) for x, d in zip(args, dims, strict=True))

            dims = [d if isinstance(x, Tensor) else None for x, d in zip(args, in_dims, strict=True)]
            results = [op(*item(i)) for i in range(info.batch_size)]
            if isinstance(results[0], Tensor):
                return torch.stack(results), 0
            return tuple(map(torch.stack, zip(*results, strict=True))), (0,) * len(results[0])

        torch.library.register_vmap(op, one_by_one, lib=_LIBRARY)
    return op


def _schema_type(hint) -> str:
    if get_origin(hint) is tuple:
        return f"({', '.join(map(_schema_type, get_args(hint)))})"
    return _TYPES[hint]


def register_autograd(op, backward, setup_context=None):
    """Registers the gradient of an operator, of the same form as in ``torch.library.register_autograd``."""

    def below(*args):
        with torch._C._AutoDispatchBelowAutograd():
            return op(*args)

    def forward(*args):
        if not torch._C._are_functorch_transforms_active():
            return below(*args)
        # apply() has switched gradients off; the transforms further out need theirs.
        with torch.enable_grad(), forward_ad._set_fwd_grad_enabled(True):
            return below(*args)

    def set_up(ctx, inputs, output):
        if setup_context is not None:
            setup_context(ctx, inputs, output)

    def jvp(ctx, *tangents):
        raise RuntimeError(
            f"{op.name()} has no forward-mode derivative (torch.func.jvp, torch.autograd.forward_ad); "
            "use reverse mode: backward(), or torch.func.grad, vjp or jacrev"
        )

    # The kind of autograd.Function that may be used below torch.func's transforms, each of which calls `kernel`.
    parts = {"forward": forward, "setup_context": set_up, "backward": backward, "jvp": jvp}
    function = type(
        f"nmr_{op._opname}",
        (torch.autograd.function._SingleLevelFunction,),
        {name: staticmethod(part) for name, part in parts.items()},
    )

    def kernel(*args):
        wanted = torch.is_grad_enabled() and any(isinstance(x, Tensor) and x.requires_grad for x in args)
        if not wanted and forward_ad._current_level < 0:
            return below(*args)
        if not torch._C._are_functorch_transforms_active():
            return function.apply(*args)
        from torch._functorch.autograd_function import enable_single_level_autograd_function

        with enable_single_level_autograd_function():
            return function.apply(*args)

    _LIBRARY.impl(op._opname, kernel, "Autograd")
