"""The soft silhouette of SoftRas."""

import pytest
import torch

import nmr
from nmr import reference


def soup(seed, dtype=torch.float64, num_faces=10):
    """Random triangles in renderer space, some of them partly off the screen, some thin."""
    g = torch.Generator().manual_seed(seed)
    centre = torch.rand(num_faces, 1, 3, generator=g) * 2 - 1
    corners = centre + 0.4 * torch.randn(num_faces, 3, 3, generator=g)
    corners[0, 2] = corners[0, :2].mean(0) + 0.002
    corners[..., 2] = 1 + torch.rand(num_faces, 3, generator=g)
    return corners.view(-1, 3).to(dtype), torch.arange(num_faces * 3).view(-1, 3)


@pytest.mark.parametrize("image_size", [24, (16, 40), (33, 17)])
@pytest.mark.parametrize("sigma", [1e-5, 1e-3, 0.1])
@pytest.mark.parametrize("fill_back", [False, True])
def test_equals_the_slow_definition(image_size, sigma, fill_back):
    vertices, faces = soup(0)
    vertices.requires_grad_()
    options = {"sigma": sigma, "fill_back": fill_back}
    alpha = nmr.render_soft_silhouette(vertices, faces, image_size=image_size, **options)[0]
    wanted = reference.soft_silhouette(vertices, faces, image_size, **options)
    torch.testing.assert_close(alpha, wanted, rtol=0, atol=1e-12)
    upstream = torch.randn(alpha.shape, dtype=alpha.dtype, generator=torch.Generator().manual_seed(1))
    grad, slow = (torch.autograd.grad(image, vertices, upstream)[0] for image in (alpha, wanted))
    torch.testing.assert_close(grad, slow, rtol=1e-9, atol=1e-9 * float(slow.abs().max()))
    assert slow.any() and not grad[:, 2].any()
    single = vertices.detach().float().requires_grad_()
    image = nmr.render_soft_silhouette(single, faces, image_size=image_size, **options)[0]
    # A float32 distance of 1e-7 moves D by 1e-7 d / sigma.
    torch.testing.assert_close(image.double(), alpha, rtol=0, atol=max(2e-6, 2e-8 / sigma))
    (single_grad,) = torch.autograd.grad(image, single, upstream.float())
    assert (single_grad - grad).norm() < 1e-3 * grad.norm()


def test_a_face_of_one_vertex_is_none():
    vertices, faces = soup(2)
    more = torch.cat([faces, torch.zeros(5, 3, dtype=torch.int64)])
    images = [nmr.render_soft_silhouette(vertices, f, sigma=0.1, image_size=16)[0] for f in (faces, more)]
    assert torch.equal(*images)
    torch.testing.assert_close(images[1], reference.soft_silhouette(vertices, more, 16, sigma=0.1))


@pytest.mark.parametrize("anti_aliasing", [False, True])
def test_gradients_are_the_derivative(anti_aliasing):
    vertices, faces = soup(1)
    camera = nmr.LookAt([0.0, 0.0, -2.0], half_fov_deg=25.0)

    def draw(vertices, sigma):  # faces are left out nowhere, so that the image is smooth
        options = {"sigma": sigma, "dist_eps": 1e-30, "image_size": (5, 8), "anti_aliasing": anti_aliasing}
        return nmr.render_soft_silhouette(vertices, faces[1:], camera, **options)

    given = vertices.requires_grad_(), torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(draw, given, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_published_constants():
    # One vertical border at x = 0: D = 0.5 there, sigmoid(-+d^2 / sigma) beside it, 0 beyond the distance of dist_eps.
    vertices = torch.tensor([[0.0, -9.0, 1.0], [9.0, 0.0, 1.0], [0.0, 9.0, 1.0]], dtype=torch.float64)
    alpha = nmr.render_soft_silhouette(vertices, torch.tensor([[0, 1, 2]]), image_size=(1, 1001))[0, 0]
    torch.testing.assert_close(alpha[500], torch.tensor(0.5, dtype=torch.float64))
    vertices = vertices / torch.tensor([900.0, 9.0, 1.0])  # in a square of 400 pixels
    alpha = nmr.render_soft_silhouette(vertices, torch.tensor([[0, 1, 2]]), image_size=400)[0, 200]
    d = (2 * torch.arange(400, dtype=torch.float64) - 399) / 400
    left = d < 0
    wanted = torch.sigmoid(-d.square() / 1e-5)
    wanted[wanted < 1e-4] = 0
    torch.testing.assert_close(alpha[left], wanted[left], rtol=1e-6, atol=1e-12)
    assert 0 < alpha[left & (alpha > 0)].min() < 1e-2


def test_with_a_small_sigma_it_is_the_silhouette():
    vertices, faces = nmr.icosphere(3)
    camera = nmr.LookAt.from_angles(2.732, 30.0, [0.0, 70.0], half_fov_deg=30.0)
    for image_size in (64, (48, 80)):
        soft = nmr.render_soft_silhouette(vertices, faces, camera, sigma=1e-9, image_size=image_size)
        hard = nmr.render_silhouette(vertices, faces, camera, image_size=image_size, anti_aliasing=False)
        assert ((soft - hard).abs() > 0.01).float().mean() < 0.01
    averaged = nmr.render_soft_silhouette(vertices, faces, camera, image_size=32, anti_aliasing=True)
    fine = nmr.render_soft_silhouette(vertices, faces, camera, image_size=64)
    torch.testing.assert_close(averaged, fine.view(2, 32, 2, 32, 2).mean((2, 4)), rtol=0, atol=1e-6)


@pytest.mark.parametrize("shift", [-3.0, 200.0])
def test_faces_out_of_range_draw_nothing(shift):
    vertices, faces = soup(2)
    away = vertices + torch.tensor([0.0, 0.0, shift])
    assert not nmr.render_soft_silhouette(away, faces, image_size=16, clip=False).any()
