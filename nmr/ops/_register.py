"""How the operators are registered: ``@operator`` for the kernel, ``register_autograd`` for its gradient.

An operator is a function of tensors and numbers, given by position. Calls with plain tensors reach the kernel through a
``torch.autograd.Function``, or directly if no gradient is wanted: for small meshes the dispatcher takes longer than the
kernel. Everything else (torch.compile, torch.export, fake tensors) reaches it through ``torch.ops.nmr``.
"""

from __future__ import annotations

import functools
import inspect
from typing import Optional, get_args, get_origin, get_type_hints

import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

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
_PLAIN = {Tensor, torch.nn.Parameter, type(None), bool, int, float, list}


def operator(kernel):
    """Registers a function of plain tensors as the operator ``nmr::<its name>`` on all devices.

    Its arguments and results need types, and have no default values (torch would leave out arguments equal to them).
    The results are new tensors. Inside ``torch.func.vmap`` the operator is called once per item.

    Returns
    -------
    function
        Calls the operator; its attribute ``op`` is torch's (for ``register_fake`` and ``opcheck``).
    """
    name, hints = kernel.__name__, get_type_hints(kernel)
    parameters = inspect.signature(kernel).parameters.values()
    assert all(p.default is p.empty for p in parameters), f"{name}: arguments of operators have no default values"
    arguments = ", ".join(f"{_schema_type(hints[p.name])} {p.name}" for p in parameters)
    schema = f"{name}({arguments}) -> {_schema_type(hints['return'])}"
    _LIBRARY.define(schema, tags=(torch.Tag.pt2_compliant_tag,))
    _LIBRARY.impl(name, kernel, "CompositeExplicitAutograd")
    op = getattr(torch.ops.nmr, name).default

    @functools.wraps(kernel)
    def call(*args):
        if torch.compiler.is_compiling() or not _PLAIN.issuperset(map(type, args)):
            return op(*args)
        if call.apply is op or not _gradient_is_wanted(args):
            try:
                return kernel(*args)
            except RuntimeError:  # inside torch.func's transforms values cannot be read
                pass
        return call.apply(*args)

    def one_by_one(info, in_dims, *args):
        def item(i):
            return (x if d is None else x.select(d, i) for x, d in zip(args, dims, strict=True))

        dims = [d if isinstance(x, Tensor) else None for x, d in zip(args, in_dims, strict=True)]
        results = [call(*item(i)) for i in range(info.batch_size)]
        if isinstance(results[0], Tensor):
            return torch.stack(results), 0
        return tuple(map(torch.stack, zip(*results, strict=True))), (0,) * len(results[0])

    if hasattr(torch.library, "register_vmap"):  # torch < 2.5 loops, too, but warns that it is slow
        torch.library.register_vmap(op, one_by_one, lib=_LIBRARY)
    call.op, call.kernel, call.vmap, call.apply = op, kernel, one_by_one, op
    return call


def _schema_type(hint) -> str:
    if get_origin(hint) is tuple:
        return f"({', '.join(map(_schema_type, get_args(hint)))})"
    return _TYPES[hint]


def _gradient_is_wanted(args) -> bool:
    """In reverse mode, or in forward mode, which is an error."""
    tensors = [x for x in args if isinstance(x, Tensor)]
    if torch.is_grad_enabled() and any([x.requires_grad for x in tensors]):
        return True
    return any([unpack_dual(x).tangent is not None for x in tensors])


def register_autograd(operator, backward, setup_context=None):
    """Registers the gradient of an operator, of the same form as in ``torch.library.register_autograd``."""
    op, kernel = operator.op, operator.kernel
    torch.library.register_autograd(op, backward, setup_context=setup_context, lib=_LIBRARY)

    def forward(*args):
        return kernel(*args) if _PLAIN.issuperset(map(type, args)) else op(*args)

    forward.__signature__ = inspect.signature(forward)  # torch asks for it at each call

    def set_up(ctx, inputs, output):
        if setup_context is not None:
            setup_context(ctx, inputs, output)

    def jvp(ctx, *tangents):
        raise RuntimeError(
            f"{op.name()} has no forward-mode derivative (torch.func.jvp, torch.autograd.forward_ad); "
            "use reverse mode: backward(), or torch.func.grad, vjp or jacrev"
        )

    parts = {"forward": forward, "setup_context": set_up, "backward": backward, "jvp": jvp, "vmap": operator.vmap}
    name = op.name().replace("::", "_")
    function = type(name, (torch.autograd.Function,), {name: staticmethod(part) for name, part in parts.items()})
    operator.apply = function.apply
