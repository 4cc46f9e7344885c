"""Lists of meshes of different sizes: the same bits as one by one, for every output and gradient; bad lists."""

import pytest
import torch

import nmr

SIZE = dict(image_size=24)


def sphere(subdivisions, seed, scale):
    vertices, faces = nmr.icosphere(subdivisions)
    noise = torch.rand(len(vertices), 1, generator=torch.Generator().manual_seed(seed))
    return scale * (0.6 + 0.4 * noise) * vertices, faces


MESHES = [sphere(2, 0, 0.9), sphere(1, 1, 0.6), sphere(3, 2, 0.8)]
VERTICES, FACES = [v for v, _ in MESHES], [f for _, f in MESHES]
EYES = torch.tensor([[0.0, 0.5, -2.5], [1.5, 0.0, -2.0], [-1.0, 1.0, 2.0]])


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("smooth", [False, True])
def test_lights_per_image(smooth):
    parameters = [uniform(3), uniform(3, 2), uniform(3, 2, 3) - 0.5, uniform(3, 3), uniform(3, 2, 3)]
    parameters = [x.requires_grad_() for x in parameters]
    together = nmr.render_rgb(VERTICES, FACES, nmr.LookAt(EYES), lights=nmr.Lights(*parameters, smooth), **SIZE)
    grads = torch.autograd.grad(together.square().sum(), parameters)
    for b in range(3):
        own = [x[b].detach().requires_grad_() for x in parameters]
        alone = nmr.render_rgb(VERTICES[b], FACES[b], nmr.LookAt(EYES[b]), lights=nmr.Lights(*own, smooth), **SIZE)
        assert torch.equal(alone[0], together[b])
        for grad, own_grad in zip(grads, torch.autograd.grad(alone.square().sum(), own), strict=True):
            torch.testing.assert_close(grad[b], own_grad, rtol=1e-4, atol=1e-4)


def test_values_of_a_batch_may_be_lists():
    vertices = torch.stack([VERTICES[0], 0.7 * VERTICES[0]])
    image, uv, uv_faces = uniform(2, 4, 4, 3), uniform(2, 50, 2), torch.stack([FACES[0] % 50, FACES[0] % 49])
    stacked, lists = (
        nmr.render_rgb(vertices, FACES[0], nmr.LookAt(EYES[:2]), colors=nmr.UVTexture(*values), **SIZE)
        for values in ((image, uv, uv_faces), (list(image), list(uv), list(uv_faces)))
    )
    assert torch.equal(stacked, lists) and stacked.any()


def test_a_list_of_one_grows_to_the_cameras_batch():
    one = nmr.render_silhouette([VERTICES[0]], [FACES[0]], nmr.LookAt(EYES), **SIZE)
    assert torch.equal(one, nmr.render_silhouette(VERTICES[0], FACES[0], nmr.LookAt(EYES), **SIZE))
