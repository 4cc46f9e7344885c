"""Makes operators of the compiled kernels: ``@kernel`` turns the shapes of a kernel's results
into an operator.

An operator is a function of tensors, then numbers, given by position, without default values
(torch would leave out arguments equal to them). Calls with plain tensors reach the kernel through a
``torch.autograd.Function``, or directly if no gradient is wanted: for small meshes the dispatcher
takes longer than the kernel. Everything else (torch.compile, torch.export, fake tensors) reaches
it through ``torch.ops.nmr``.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Optional, ParamSpec, TypeVar, get_args, get_origin, get_type_hints

import torch
from torch import Tensor
from torch._C._functorch import unwrap_if_dead
from torch.autograd import forward_ad

try:
    from .. import _C
except ImportError as error:
    raise ImportError(
        "the compiled part of nmr is missing: Python imports the source folder, or the installation failed; "
        "run `pip install .` in the repository and start Python in another folder, or use `pip install -e .`"
    ) from error

P, R = ParamSpec("P"), TypeVar("R")

_LIBRARY = torch.library.Library("nmr", "FRAGMENT")
_MAYBE = Optional[Tensor]  # noqa: UP045, equal to Tensor | None
# In torch's schema language. Lists of tensors would have no gradient.
_TYPES = {
    Tensor: "Tensor",
    _MAYBE: "Tensor?",
    bool: "bool",
    int: "SymInt",
    float: "float",
    list[bool]: "bool[]",
}
# Kernels by name: the names of their arguments, and the function that takes them by position.
COMPILED: dict[str, tuple[list[str], Callable]] = {}
_PLAIN = {Tensor, torch.nn.Parameter, type(None), bool, int, float, list}


def kernel(
    results: str,
    *,
    gradients: str = "",
    keep: str = "",
    constant: str = "",
    used_by: str = "",
    twice=None,
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorates a function that allocates the results of a kernel, given its arguments: the
    operator ``nmr::<name>``.

    Parameters
    ----------
    results : str
        Names of the results in ``nmr._C``, where the kernel has the name of the function. Its
        arguments have their own.
    gradients : str
        Names of the differentiable arguments. Their gradients come from ``<name>_backward`` of
        ``nmr._C``: its arguments are those of the kernel, the results in ``keep`` and
        ``constant``, and ``grad_<result>`` of the results that have a gradient.
    keep, constant : str
        Results that the backward pass needs; ``constant``: they have no gradient.
    used_by : str
        The public function, for the error that it has no second derivative.
    twice : function, optional
        The first result in torch, the only one with a gradient: for second derivatives, if there
        are any.

    Returns
    -------
    function
        Calls the operator. Its attribute ``op`` is torch's, for ``opcheck``; ``backward`` is the
        operator of the gradients: arguments as above, then ``wanted``, a flag for each
        differentiable argument. A gradient that is not wanted is empty.
    """

    def decorate(allocate: Callable[P, R]) -> Callable[P, R]:
        hints = get_type_hints(allocate)
        call = _operator(allocate.__name__, hints, hints.pop("return"), allocate, results.split())
        functools.update_wrapper(call, allocate)
        if gradients:
            kept = {"keep": keep.split(), "constant": constant.split()}
            call.backward = _add_gradient(call, hints, results.split(), gradients.split(), **kept)
            _refuse_gradient(call.backward, used_by) if twice is None else _add_second(
                call.backward, twice, len(hints), call.differentiable
            )
        return call

    return decorate


def _operator(
    name: str, hints: dict, returned: type, allocate: Callable, results: list[str]
) -> Callable:
    """Registers a kernel, its fake (``allocate``) and its vmap rule: one call per item."""
    several = get_origin(returned) is tuple
    first = next(k for k, hint in enumerate(hints.values()) if hint is Tensor)
    has_wanted = "wanted" in hints  # the last argument: the results that the kernel is to compute
    names = [*(hint for hint in hints if hint != "wanted"), *results, "num_threads"]
    COMPILED[name] = names, _C.bind(name, names)

    def run(*args):
        like = args[first]
        if not like.is_cpu:
            outputs = run(*(x.cpu() if isinstance(x, Tensor) else x for x in args))
            if not several:
                return outputs.to(like.device)
            # a gradient goes to the device of its argument
            pairs = zip(outputs, allocate(*args), strict=True)
            return tuple(x if x is None else x.to(to.device) for x, to in pairs)
        outputs = allocate(*args)
        found = outputs if several else (outputs,)
        given = args[:-1] if has_wanted else args
        COMPILED[name][1](*given, *found, torch.get_num_threads())
        return outputs

    def filled(compute, args):
        """The results of ``compute``. Those that are not wanted are empty: torch needs tensors."""
        outputs = compute(*args)
        if not has_wanted:
            return outputs
        nothing = args[first].new_empty
        if not several:
            return nothing(0) if outputs is None else outputs
        return tuple(nothing(0) if x is None else x for x in outputs)

    def call(*args):
        if torch.compiler.is_compiling() or not _PLAIN.issuperset(map(type, args)):
            return op(*args)
        if torch._C._are_functorch_transforms_active():
            return call.transformed(*args)
        if call.direct is not None:
            if in_forward_mode(*args):
                return call.transformed(*args)  # an error
            if torch.is_grad_enabled() and any([_wants(args[k]) for k in call.differentiable]):
                return call.direct(*args)
        return run(*args)

    def one_by_one(info, in_dims, *args):
        def item(i):
            return (x if d is None else x.select(d, i) for x, d in zip(args, dims, strict=True))

        dims = [d if isinstance(x, Tensor) else None for x, d in zip(args, in_dims, strict=True)]
        items = [filled(call, list(item(i))) for i in range(info.batch_size)]
        if not several:
            return torch.stack(items), 0
        return tuple(map(torch.stack, zip(*items, strict=True))), (0,) * len(results)

    arguments = ", ".join(f"{_TYPES[hint]} {argument}" for argument, hint in hints.items())
    of_results = (
        f"({', '.join(_TYPES[hint] for hint in get_args(returned))})"
        if several
        else _TYPES[returned]
    )
    _LIBRARY.define(f"{name}({arguments}) -> {of_results}", tags=(torch.Tag.pt2_compliant_tag,))
    call.run = lambda *args: filled(run, args)
    _LIBRARY.impl(name, call.run, "CompositeExplicitAutograd")
    op = getattr(torch.ops.nmr, name).default
    torch.library.register_fake(op, lambda *args: filled(allocate, args), lib=_LIBRARY)
    if hasattr(torch.library, "register_vmap"):  # torch < 2.5 loops, too, but warns that it is slow
        torch.library.register_vmap(op, one_by_one, lib=_LIBRARY)
    call.op, call.vmap, call.direct, call.transformed = op, one_by_one, None, op
    call.differentiable = [k for k, hint in enumerate(hints.values()) if hint in (Tensor, _MAYBE)]
    return call


def _wants(x: object) -> bool:
    return x is not None and x.requires_grad


def in_forward_mode(*values: object) -> bool:
    """Whether a tensor among them has a tangent."""
    if forward_ad._current_level < 0:
        return False
    return any(
        isinstance(x, Tensor) and forward_ad.unpack_dual(x).tangent is not None for x in values
    )


def _add_gradient(
    forward: Callable,
    hints: dict,
    results: list[str],
    gradients: list[str],
    keep: list[str],
    constant: list[str],
) -> Callable:
    """Registers the operator of the gradients, and with it the gradient of ``forward``."""
    names, count = list(hints), len(hints)
    num_tensors = sum(hint in (Tensor, _MAYBE) for hint in hints.values())  # which come first
    of = [names.index(name) for name in gradients]
    without = [k for k, name in enumerate(results) if name in constant]
    kept = [k for k, name in enumerate(results) if name in (*keep, *constant)]
    upstream = [k for k in range(len(results)) if k not in without]

    def allocate(*args):  # None: not wanted
        grads = [
            args[k].new_empty(args[k].shape) if want else None
            for k, want in zip(of, args[-1], strict=True)
        ]
        return tuple(grads) if len(of) > 1 else grads[0]

    # A gradient is None if a result is not used.
    added = {results[k]: Tensor for k in kept}
    added |= {f"grad_{results[k]}": Tensor if len(results) == 1 else _MAYBE for k in upstream}
    returned = tuple[(Tensor,) * len(of)] if len(of) > 1 else Tensor
    name, found = (
        f"{forward.op.name().removeprefix('nmr::')}_backward",
        [f"grad_{name}" for name in gradients],
    )
    backward = _operator(name, hints | added | {"wanted": list[bool]}, returned, allocate, found)

    def save(ctx, inputs, outputs):
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*inputs[:num_tensors], *[outputs[k] for k in kept])
        ctx.numbers = inputs[num_tensors:]

    def go_back(ctx, saved, grads, wanted):
        tensors, results = saved[:num_tensors], saved[num_tensors:]
        found = backward(*tensors, *ctx.numbers, *results, *grads, wanted)
        return (found,) if len(of) == 1 else found

    def set_up(ctx, inputs, output):
        outputs = (output,) if len(results) == 1 else output
        if without:
            ctx.mark_non_differentiable(*(outputs[k] for k in without))
        save(ctx, inputs, outputs)

    def pull(ctx, *grads):
        grads, wanted = [grads[k] for k in upstream], [ctx.needs_input_grad[k] for k in of]
        found: list[Tensor | None] = [None] * count
        if any(wanted) and any([grad is not None for grad in grads]):
            # a pullback of torch.func.vjp runs after the transform whose wrappers it has saved
            saved = [x if x is None else unwrap_if_dead(x) for x in ctx.saved_tensors]
            pulled = go_back(ctx, saved, grads, wanted)
            for k, want, grad in zip(of, wanted, pulled, strict=True):
                found[k] = grad if want else None
        return tuple(found)

    _register_autograd(forward, pull, set_up)

    # For plain tensors. torch takes about a microsecond for each argument and result of a
    # Function: here these are the arguments as one, those that want a gradient, and the results
    # that have one.
    def forward_directly(ctx, args, wanted, *_):
        output = forward.run(*args)
        outputs = (output,) if len(results) == 1 else output
        save(ctx, args, outputs)
        ctx.wanted, ctx.outputs = wanted, outputs if without else None
        return tuple([outputs[k] for k in upstream])

    def pull_directly(ctx, *grads):
        needed = iter(ctx.needs_input_grad[2:])
        wanted = [want and next(needed) for want in ctx.wanted]
        found = [None] * len(of)
        if any(wanted) and any([grad is not None for grad in grads]):
            found = go_back(ctx, ctx.saved_tensors, grads, wanted)
        return None, None, *[grad for want, grad in zip(ctx.wanted, found, strict=True) if want]

    function = _function(forward.op, forward=forward_directly, backward=pull_directly)
    apply = super(torch.autograd.Function, function).apply

    def direct(*args):
        wanted = [_wants(args[k]) for k in of]
        differentiable = apply(
            args, wanted, *[args[k] for k, want in zip(of, wanted, strict=True) if want]
        )
        if not without:
            return differentiable[0] if len(results) == 1 else differentiable
        node = differentiable[0].grad_fn
        outputs, node.outputs = list(node.outputs), None
        for k, x in zip(upstream, differentiable, strict=True):
            outputs[k] = x
        return tuple(outputs)

    forward.direct, forward.differentiable = direct, of
    return backward


def _refuse_gradient(backward: Callable, used_by: str) -> None:
    def refuse(ctx, *grads):
        raise RuntimeError(
            f"{used_by} has no second derivative: its gradient is computed by a kernel that is not differentiable; "
            "call backward() without create_graph=True"
        )

    _register_autograd(backward, refuse, lambda ctx, inputs, output: None)


def _add_second(backward: Callable, twice: Callable, count: int, of: list[int]) -> None:
    """``twice`` takes the first ``count`` arguments of ``backward``, which returns the gradients of
    those in ``of``.
    """

    def set_up(ctx, inputs, output):
        *arguments, ctx.wanted = inputs
        tensors = [k for k, x in enumerate(arguments) if isinstance(x, Tensor)]
        ctx.save_for_backward(*(arguments[k] for k in tensors))
        ctx.tensors, ctx.count = tensors, len(inputs)
        ctx.others = [None if k in tensors else x for k, x in enumerate(arguments)]

    def pull(ctx, *grads):
        arguments, found = list(ctx.others), [None] * ctx.count
        for k, x in zip(ctx.tensors, ctx.saved_tensors, strict=True):
            arguments[k] = x
        floats = [k for k in ctx.tensors if arguments[k].is_floating_point()]

        def result(*values):
            of_values = dict(zip(of, values, strict=True))
            return twice(*(of_values.get(k, x) for k, x in enumerate(arguments[:count])))

        def gradients(*values):
            for k, value in zip(floats, values, strict=True):
                arguments[k] = value
            *_, upstream = arguments
            pulled = torch.func.vjp(result, *(arguments[k] for k in of))[1](upstream)
            return tuple(x for x, want in zip(pulled, ctx.wanted, strict=True) if want)

        pulled = torch.func.vjp(gradients, *(arguments[k] for k in floats))[1]
        upstream = tuple(x for x, want in zip(grads, ctx.wanted, strict=True) if want)
        for k, grad in zip(floats, pulled(upstream), strict=True):
            found[k] = grad
        return tuple(found)

    _register_autograd(backward, pull, set_up)


def _register_autograd(operator: Callable, backward: Callable, set_up: Callable) -> None:
    """``backward`` and ``set_up`` are of the form that ``torch.library.register_autograd`` has."""
    op, run = operator.op, operator.run
    torch.library.register_autograd(op, backward, setup_context=set_up, lib=_LIBRARY)

    def forward(*args):
        return run(*args) if _PLAIN.issuperset(map(type, args)) else op(*args)

    def forward_with_context(ctx, *args):
        output = run(*args)
        set_up(ctx, args, output)
        return output

    # torch binds the arguments of a Function with setup_context by its signature, which takes
    # longer than the kernel of a small mesh. Only torch.func needs that form, and the apply of
    # Function, which prepares for it.
    direct = _function(op, forward=forward_with_context, backward=backward)
    operator.direct = super(torch.autograd.Function, direct).apply
    operator.transformed = _function(
        op, forward=forward, setup_context=set_up, backward=backward, vmap=operator.vmap
    ).apply


def _function(op: Callable, **parts: Callable) -> type[torch.autograd.Function]:
    def jvp(ctx, *tangents):
        raise RuntimeError(
            f"{op.name()} has no forward-mode derivative (torch.func.jvp, torch.autograd.forward_ad); "
            "use reverse mode: backward(), or torch.func.grad, vjp or jacrev"
        )

    methods = {name: staticmethod(code) for name, code in (parts | {"jvp": jvp}).items()}
    return type(op.name().replace("::", "_"), (torch.autograd.Function,), methods)
