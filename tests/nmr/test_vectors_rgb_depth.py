"""The reference vectors of depth and colour: images and gradients by the published kernels, in plain float32."""

import numpy as np
import pytest
import torch
from vectors import gradient_tolerance, load_vector, vector_names

import nmr

DEPTH = vector_names("depth_*")
RGB = vector_names("rgb_*")


def render(v):
    """The images of a vector file in its own layout, by name, and the leaves with their gradients."""
    vertices = torch.from_numpy(v["vertices"]).requires_grad_()
    faces, far, eps = torch.from_numpy(v["faces"]).long(), float(v["far"]), float(v["eps"])
    mode, anti_aliasing = str(v["mode"]), bool(v["anti_aliasing"])
    size = int(v["image_size"]) * (2 if anti_aliasing else 1)
    settings = size, size, bool(v["fill_back"]), float(v["near"]), far
    face_index = nmr.ops.rasterize(vertices.detach(), faces, None, *settings)
    if "face_index_map" in v:
        assert np.array_equal(face_index.numpy(), v["face_index_map"][:, ::-1])
    images, textures = {}, None
    if mode in ("depth", "rgbad"):
        images["depth"] = nmr.ops.depth_image(vertices, faces, None, face_index, anti_aliasing, far)
    if mode in ("rgb", "rgbad"):
        textures = torch.from_numpy(v["textures"]).requires_grad_()
        weights, _ = nmr.ops.fragments(vertices.detach(), faces, None, face_index, far)
        colors = nmr.ops.sample_texture_cubes(textures, face_index, weights, None, eps)
        covered = (face_index >= 0)[..., None]
        image = torch.where(covered, colors, torch.from_numpy(v["background"]))
        if mode == "rgbad":
            image = torch.cat([image, covered.float()], dim=-1)
        image = nmr.ops.resolve(image, None, vertices, faces, None, face_index, anti_aliasing, eps)
        images["rgb"] = image[..., :3].permute(0, 3, 1, 2)
        if mode == "rgbad":
            images["alpha"] = image[..., 3]
    torch.autograd.backward(list(images.values()), [torch.from_numpy(v[f"grad_{name}"]) for name in images])
    return images, vertices.grad.numpy(), None if textures is None else textures.grad.numpy()


def relative_difference(a, b):
    return np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-30)


def test_the_vectors_are_there():
    assert len(DEPTH) >= 22 and len(RGB) >= 12


@pytest.mark.parametrize("name", DEPTH + RGB)
def test_images_and_gradients(name):
    v = load_vector(name)
    images, grad_vertices, grad_textures = render(v)
    for kind, image in images.items():
        difference = np.abs(image.detach().numpy() - v[kind])
        difference[tuple(v[f"fragile_{kind}"].T)] = 0
        assert difference.max() <= 1e-5
    assert relative_difference(grad_vertices, v["grad_vertices"]) <= gradient_tolerance(name)
    if grad_textures is not None:
        assert np.abs(grad_textures - v["grad_textures"]).max() <= max(5 * v["grad_textures_fma_maxdiff"], 1e-5)


@pytest.mark.parametrize("name", DEPTH)
def test_depth_bit_for_bit(name):
    """Fragile pixels included: the kernels evaluate the published expressions in the published order."""
    v = load_vector(name)
    images, _, _ = render(v)
    assert np.array_equal(images["depth"].detach().numpy(), v["depth"])
