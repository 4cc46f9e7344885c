"""Batches that are drawn a few images at a time: the images and gradients of the whole batch, with less memory."""

import subprocess
import sys

import pytest
import torch

import nmr
from nmr import _chunks

BATCH = 5
G = torch.Generator().manual_seed(0)


def noise(*shape):
    return torch.rand(*shape, generator=G, dtype=torch.float64)


SPHERE, FACES = nmr.icosphere(1)
SPHERE = SPHERE.double()
VERTICES = SPHERE * (0.5 + 0.4 * noise(BATCH, len(SPHERE), 1))
OTHER = nmr.icosphere(2)
EYES = torch.tensor([[0.0, 0.5, -2.5], [1.5, 0.0, -2.0], [0.0, 0.0, -3.0], [-1.0, 1.0, 2.0], [0.0, 1.0, 2.0]]).double()
EACH = dict(ambient=noise(BATCH), direction=noise(BATCH, 2, 3), directional=noise(2), specular=noise(BATCH))
EACH |= dict(position=noise(BATCH, 1, 3), harmonics=noise(BATCH, 9, 3))
OUTPUTS = ("depth", "rgb", "alpha", "normals")


class Own:
    def __init__(self, colors):
        self.colors = colors

    def sample(self, fragments):
        return fragments.interpolate(self.colors)


def lists(x):
    return [x[0], x[1], OTHER[0].double() * 0.5, x[3], x[4]]


# vertices, faces, eyes, colours and lights of tensors that want a gradient
CASES = {
    "shared colours": lambda x, eyes: (x, FACES, eyes, nmr.VertexColors(x[0].cos()), None),
    "vertices are colours, too": lambda x, eyes: (x, FACES.expand(BATCH, -1, -1), eyes, nmr.VertexColors(x), None),
    "one mesh": lambda x, eyes: ([x[0]], FACES, eyes, nmr.FaceColors(x.repeat(1, 2, 1)[:, : len(FACES)]), None),
    "textures and lights": lambda x, eyes: (
        *(x, FACES, eyes, nmr.UVTexture(x[:, :30].unflatten(1, (5, 6)), x[..., :2], FACES, filter="mipmap")),
        nmr.Lights(**{name: value * x.sum() / x.detach().sum() for name, value in EACH.items()}),
    ),
    "normal maps": lambda x, eyes: (
        *(x, FACES, eyes, None),
        nmr.Lights(normals=nmr.NormalMap(x[:, :30].unflatten(1, (5, 6)) + 1, SPHERE[:, :2])),
    ),
    "lists": lambda x, eyes: (
        *(lists(x), [FACES, FACES, OTHER[1], FACES, FACES], eyes),
        *(nmr.VertexColors(lists(x)), nmr.Lights(smooth=True)),
    ),
    "from inside, one camera": lambda x, eyes: (x, FACES, 0.05 * eyes[:1], nmr.VertexColors(x), nmr.Lights()),
    "colours of one's own": lambda x, eyes: (x, FACES, eyes, Own(x), nmr.Lights()),
}


def draw(case, gradient, image_size):
    x, eyes = VERTICES.clone().requires_grad_(), EYES.clone().requires_grad_()
    background = torch.linspace(0, 1, 3 * BATCH).double().view(BATCH, 3).requires_grad_()
    vertices, faces, at, colors, lights = CASES[case](x, eyes)
    how = dict(colors=colors, lights=lights, background=background, image_size=image_size, gradient=gradient)
    images = nmr.render(vertices, faces, nmr.LookAt(at), outputs=OUTPUTS, interpolation_gradient=True, **how)
    sum((image * torch.linspace(0, 1, image.numel()).view_as(image)).sum() for image in images).backward()
    return *(image.detach() for image in images), x.grad, eyes.grad, background.grad


@pytest.mark.parametrize("gradient", ["nmr", "local"])
@pytest.mark.parametrize("case", CASES)
def test_chunks_draw_the_whole_batch(case, gradient, monkeypatch):
    size = (9, 12)
    whole = draw(case, gradient, size)
    chunks, made = [], _chunks.make_chunks
    monkeypatch.setattr(
        sys.modules["nmr.render"], "make_chunks", lambda *some: chunks.append(made(*some)) or chunks[-1]
    )
    monkeypatch.setattr(_chunks, "RASTER_AT_ONCE", 2 * 4 * 9 * 12)
    monkeypatch.setattr(_chunks, "FEWEST_CHUNKS", 2)
    parts = draw(case, gradient, size)
    assert (chunks[0] is None) == (case == "colours of one's own")
    for one, other in zip(whole[:4], parts[:4], strict=True):
        assert torch.equal(one, other)
    for one, other in zip(whole[4:], parts[4:], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12 * float(one.abs().max()))


def test_images_without_a_gradient_add_nothing(monkeypatch):
    monkeypatch.setattr(_chunks, "RASTER_AT_ONCE", 4 * 8 * 8)
    monkeypatch.setattr(_chunks, "FEWEST_CHUNKS", 2)
    x = VERTICES.clone().requires_grad_()
    how = dict(colors=nmr.VertexColors(VERTICES), image_size=8, gradient="none")
    rgb = nmr.render_rgb(x, FACES, nmr.LookAt(EYES), **how)
    assert torch.equal(rgb, nmr.render_rgb(VERTICES, FACES, nmr.LookAt(EYES), **how))
    (rgb.sum() + x.sum()).backward()
    assert torch.equal(x.grad, torch.ones_like(x))
    with pytest.raises(ValueError, match="must have batch size 1 or 5"):  # not 1 or 1, as in a chunk
        nmr.render_rgb(x, FACES, nmr.LookAt(EYES), **how | dict(colors=nmr.VertexColors(VERTICES[:3])))


MEMORY = """
import resource, torch, nmr

def peak_after(batch):
    v = vertices.expand(batch, -1, -1).clone().requires_grad_()
    colors = nmr.FaceColors(torch.ones(len(faces), 3))
    rgb = nmr.render_rgb(v, faces, nmr.LookAt([0.0, 0.0, -3.0]), colors=colors, lights=nmr.Lights(), image_size=128)
    rgb.sum().backward()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

nmr._chunks.FEWEST_CHUNKS = 8
vertices, faces = nmr.icosphere(1)
print((-peak_after(4) + peak_after(128)) / (128 * 256 * 256))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux")
def test_lit_batches_take_a_third_of_the_memory(tmp_path):
    """Bytes for each pixel of the raster: 60 if everything is kept."""
    run = subprocess.run([sys.executable, "-c", MEMORY], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert float(run.stdout) < 25
