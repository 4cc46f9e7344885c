"""How the operators are registered: torch.func, forward mode, graph breaks, default devices, the first call."""

import os
import subprocess
import sys

import pytest
import torch
from scenes import leaf_of

import nmr

SPHERE, FACES = nmr.icosphere(1)
CAMERA = nmr.LookAt([[0.5, 0.3, -3.0]])
SIZE = {"image_size": 16}


def depth(vertices):
    return nmr.render_depth(vertices, FACES, CAMERA, **SIZE).square().mean()


def gradient(function, vertices):
    leaf = leaf_of(vertices)
    return torch.autograd.grad(function(leaf), leaf)[0]


def test_forward_mode_of_something_else():
    """A tangent that does not pass through a renderer is right."""
    value, tangent = torch.func.jvp(
        lambda s: s * depth(SPHERE), (torch.ones(()),), (torch.ones(()),)
    )
    assert tangent == value


def test_graph_breaks():
    """Operators that run outside of the graphs of torch.compile."""

    def function(vertices):
        first = nmr.render_silhouette(vertices, FACES, CAMERA, **SIZE).square().mean()
        torch._dynamo.graph_break()
        return first * depth(vertices)

    compiled = torch.compile(function, backend="aot_eager")
    assert torch.equal(gradient(compiled, SPHERE), gradient(function, SPHERE))


def test_torch_func_inside_of_a_compiled_function_is_an_error():
    with pytest.raises(RuntimeError):
        torch.compile(torch.func.grad(depth), backend="aot_eager")(SPHERE)


def test_export():
    class Depth(torch.nn.Module):
        def forward(self, vertices):
            return depth(vertices)

    program = torch.export.export(Depth(), (SPHERE,)).module()
    assert torch.equal(program(SPHERE), depth(SPHERE))


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
