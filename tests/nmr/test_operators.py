"""How the operators are registered: torch.func, forward mode, graph breaks, default devices, the first call."""

import os
import subprocess
import sys

import pytest
import torch
from scenes import leaf_of, same_bits
from torch.autograd import forward_ad

import nmr

SPHERE, FACES = nmr.icosphere(1)
CAMERA = nmr.LookAt([[0.5, 0.3, -3.0]])
EDGES = nmr.edge_table(FACES)
SIZE = {"image_size": 16}
MESHES = torch.stack([SPHERE, 0.6 * SPHERE, SPHERE * torch.tensor([1.0, 0.5, 0.7])])
COLORS = torch.linspace(0, 1, SPHERE.numel()).view_as(SPHERE)
RAMP = torch.linspace(-1, 1, 256).view(16, 16)


def rgb(vertices, gradient="nmr"):
    colors = nmr.VertexColors(COLORS)
    image = nmr.render_rgb(vertices, FACES, CAMERA, colors=colors, gradient=gradient, **SIZE)
    return (image * RAMP.unsqueeze(-1)).sum()


# Functions of vertices [V, 3] with scalar values.
FUNCTIONS = {
    "silhouette": lambda v: (nmr.render_silhouette(v, FACES, CAMERA, **SIZE) * RAMP).sum(),
    "local": lambda v: (
        nmr.render_silhouette(v, FACES, CAMERA, gradient="local", **SIZE) * RAMP
    ).sum(),
    "depth": lambda v: (nmr.render_depth(v, FACES, CAMERA, **SIZE) * RAMP).sum(),
    "rgb": rgb,
    "local rgb": lambda v: rgb(v, "local"),
    "smoothness": lambda v: nmr.losses.smoothness_loss(v, EDGES),
}


def gradient(function, vertices):
    leaf = leaf_of(vertices)
    return torch.autograd.grad(function(leaf), leaf)[0]


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_torch_func(function):
    """grad, vjp, jacrev, vmap and vmap of grad: the same bits as backward(), mesh by mesh."""
    one = MESHES[0]
    values = torch.stack([function(mesh) for mesh in MESHES])
    wanted = torch.stack([gradient(function, mesh) for mesh in MESHES])
    assert wanted.abs().sum((1, 2)).min() > 0
    grad, vmap = torch.func.grad(function), torch.func.vmap
    value, pull = torch.func.vjp(function, one)
    last = vmap(grad, in_dims=2, out_dims=2)(MESHES.permute(1, 2, 0)).permute(2, 0, 1)
    assert same_bits((value, vmap(function)(MESHES)), (values[0], values))
    with torch.no_grad():
        without_graph = pull(torch.ones(()))[0]
    for each in (
        grad(one),
        torch.func.jacrev(function)(one),
        pull(torch.ones(()))[0],
        without_graph,
    ):
        assert torch.equal(each, wanted[0])
    assert same_bits((vmap(grad)(MESHES), last), (wanted, wanted))


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_second_derivatives_in_torch_func(function):
    with pytest.raises(RuntimeError, match="has no second derivative"):
        torch.func.grad(lambda v: torch.func.grad(function)(v).sum())(SPHERE)


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_two_levels_of_torch_func(function):
    """The gradient of the outer transform passes through the inner one."""

    def outer(vertices):
        return torch.func.grad(lambda scale: scale * function(vertices))(torch.tensor(2.0))

    assert torch.equal(torch.func.grad(outer)(SPHERE), gradient(function, SPHERE))


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_forward_mode_is_an_error(function):
    """And not 0, in torch.func and in torch.autograd, with and without a gradient in reverse mode."""
    with pytest.raises(RuntimeError, match=r"no forward-mode derivative.*use reverse mode"):
        torch.func.jvp(function, (SPHERE,), (SPHERE,))
    for leaf in (SPHERE, leaf_of(SPHERE)):
        with (
            forward_ad.dual_level(),
            pytest.raises(RuntimeError, match="no forward-mode derivative"),
        ):
            function(forward_ad.make_dual(leaf, SPHERE))


def test_forward_mode_of_something_else():
    """A tangent that does not pass through a renderer is right."""
    value, tangent = torch.func.jvp(
        lambda s: s * FUNCTIONS["depth"](SPHERE), (torch.ones(()),), (torch.ones(()),)
    )
    assert tangent == value


def test_graph_breaks():
    """Operators that run outside of the graphs of torch.compile."""

    def function(vertices):
        first = FUNCTIONS["silhouette"](vertices)
        torch._dynamo.graph_break()
        return first * FUNCTIONS["depth"](vertices)

    compiled = torch.compile(function, backend="aot_eager")
    assert torch.equal(gradient(compiled, SPHERE), gradient(function, SPHERE))


def test_export():
    class Depth(torch.nn.Module):
        def forward(self, vertices):
            return nmr.render_depth(vertices, FACES, CAMERA, **SIZE)

    program = torch.export.export(Depth(), (MESHES,)).module()
    assert torch.equal(program(MESHES), Depth()(MESHES))


def test_the_first_render_imports_no_compiler():
    """It takes milliseconds; torch._dynamo alone takes a second."""
    program = """
import sys, torch, nmr
vertices, faces = nmr.icosphere(2)
image = nmr.render_silhouette(vertices.requires_grad_(), faces, nmr.LookAt([0.0, 0.0, -3.0]), image_size=32)
image.sum().backward()
assert vertices.grad.any()
print("torch._dynamo" in sys.modules)
"""
    run = subprocess.run(
        [sys.executable, "-I", "-c", program], capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "False"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_forked_process_renders_if_its_parent_has_several_threads():
    """OpenMP's threads do not exist in the child: a loop with two would wait for ever."""
    program = """
import os, signal, torch, nmr
vertices, faces = nmr.icosphere(2)
vertices = (vertices * torch.linspace(0.5, 1, 8).view(-1, 1, 1)).requires_grad_()

def render():
    image = nmr.render_silhouette(vertices, faces, nmr.LookAt([0.0, 0.0, -3.0]), image_size=32)
    (grad,) = torch.autograd.grad(image.sum(), vertices)
    return grad

def threads():
    return len(os.listdir("/proc/self/task")) if os.path.isdir("/proc/self/task") else 0

torch.set_num_threads(2)
wanted = render()
for _ in range(200):  # on busy cores some loops take one thread
    render()
child = os.fork()
if child == 0:
    signal.alarm(60)  # ends a child that hangs
    before = threads()
    same = all(torch.equal(render(), wanted) for _ in range(200))
    os._exit(0 if same and torch.get_num_threads() == 2 and threads() == before else 1)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    subprocess.run([sys.executable, "-I", "-c", program], check=True, timeout=200)
