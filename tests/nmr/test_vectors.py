"""The reference vectors: silhouettes and their gradients by the published kernels, evaluated in plain float32."""

import numpy as np
import pytest
import reference
import torch
from vectors import gradient_tolerance, load_vector, vector_names

import nmr

SILHOUETTES = vector_names("sil_*")
QUIRKS = vector_names("quirk_sil_*")
SMALL = [
    name
    for name in SILHOUETTES
    if load_vector(name)["vertices"].shape[1] <= 24 and int(load_vector(name)["image_size"]) <= 33
]


def settings_of(v):
    settings = {
        name: v[name].item()
        for name in ("image_size", "anti_aliasing", "fill_back", "near", "far", "eps")
    }
    return settings | {"clip": False}  # the published renderer does not clip


def draw(name):
    v = load_vector(name)
    vertices = torch.from_numpy(v["vertices"]).requires_grad_()
    alpha = nmr.render_silhouette(vertices, torch.from_numpy(v["faces"]), **settings_of(v))
    alpha.backward(torch.from_numpy(v["grad_alpha"]))
    return v, alpha.detach().numpy(), vertices.grad.numpy()


def test_the_vectors_are_there():
    assert len(SILHOUETTES) >= 23 and len(QUIRKS) == 2 and len(SMALL) >= 10


def relative_difference(value, expected):
    return np.linalg.norm(value.astype(np.float64) - expected) / max(
        np.linalg.norm(expected.astype(np.float64)), 1e-30
    )


@pytest.mark.parametrize("name", SILHOUETTES)
def test_silhouette_bit_for_bit_and_gradient(name):
    """Pulls are summed in another order than published, and two share a division: far within the stated latitude."""
    v, alpha, grad = draw(name)
    assert np.array_equal(alpha, v["alpha"])
    assert gradient_tolerance(name) >= 1e-4
    assert relative_difference(grad, v["grad_vertices"]) <= 2e-6
    assert np.array_equal(grad == 0, v["grad_vertices"] == 0)


@pytest.mark.parametrize("name", [n for n in SILHOUETTES if "face_index_map" in load_vector(n)])
def test_index_map(name):
    v = load_vector(name)
    num_faces, expected = len(v["faces"]), v["face_index_map"][:, ::-1]
    mesh = (torch.from_numpy(v["vertices"]), torch.from_numpy(v["faces"]).long())
    size = expected.shape[1]
    how = {"fill_back": bool(v["fill_back"]), "near": float(v["near"]), "far": float(v["far"])}
    fragments = nmr.render_fragments(*mesh, image_size=size, clip=False, **how)
    assert np.array_equal(fragments.sided_face_index.numpy(), expected)
    public = nmr.render_face_index(*mesh, image_size=size, clip=False, **how)
    assert np.array_equal(
        public.numpy(), np.where(expected >= num_faces, expected - num_faces, expected)
    )


@pytest.mark.parametrize("name", QUIRKS)
def test_no_stray_pixels_of_collinear_faces(name):
    """The published kernels paint pixels all along the line through the face; a clean renderer paints none."""
    v, alpha, grad = draw(name)
    assert v["alpha"].any() and not alpha.any() and not grad.any()


@pytest.mark.parametrize("name", SMALL)
def test_reference_agrees_with_vectors(name):
    """The slow pure-torch definition, so that other tests may lean on it."""
    v = load_vector(name)
    aa, back, near, far, eps = (
        settings_of(v)[name] for name in ("anti_aliasing", "fill_back", "near", "far", "eps")
    )
    faces, size = torch.from_numpy(v["faces"]).long(), v["image_size"].item() * (2 if aa else 1)
    for b in range(len(v["vertices"])):
        vertices = torch.from_numpy(v["vertices"][b])
        grad_alpha = torch.from_numpy(v["grad_alpha"][b])
        index = reference.face_index(vertices, faces, size, back, near, far)
        assert np.array_equal(reference.silhouette(index, aa).numpy(), v["alpha"][b])
        grad = reference.silhouette_gradient(vertices, faces, index, grad_alpha, aa, back, eps)
        scale = np.abs(v["grad_vertices"][b]).max()
        np.testing.assert_allclose(
            grad.numpy(), v["grad_vertices"][b], rtol=1e-4, atol=1e-5 * scale
        )
