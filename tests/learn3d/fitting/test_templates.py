"""Pictures become generated shapes with the same outline."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
import trimesh

import nmr
from learn3d.data.layouts import load_dataset
from learn3d.fitting.smoothing import divide, sharpen, smooth
from learn3d.fitting.templates import learn_templates, template
from learn3d.make_data.config import DatasetConfig
from learn3d.make_data.sharded import make_shards
from learn3d.pictures.studio import photograph
from learn3d.pictures.surfaces import Surface
from learn3d.reconstruction import Model, load_model, reconstruct_picture


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model(None)


def picture(category: str, number: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = template(category, number)
    camera = nmr.LookAt.from_angles(2.7, 20.0, [35.0], half_fov_deg=15.0)
    colors, mask = photograph(vertices * torch.tensor([1.1, 1.0, 0.95]), faces, (0.2, 0.5, 0.3), camera, image_size=128)
    return colors[0], mask[0]


def bodies(surface: Surface) -> int:
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy())  # it merges equal vertices
    return mesh.body_count if mesh.volume > 0 else 0  # below 0: it is inside out


def test_a_template_is_found_by_its_code_and_fitted_to_the_outline(model: Model) -> None:
    for kind, category in enumerate(model.categories):
        number = int(model.templates.numbers[kind, 8])
        colors, mask = picture(category, number)
        code = model.method.encode(torch.from_numpy(model.prepare(colors, mask))[None])[0]
        names, cosines = model.templates.nearest(code.float(), model.categories)
        assert (category, number) in names and (cosines.diff() <= 0).all()
    colors, mask = picture("chair", int(model.templates.numbers[2, 8]))
    made = reconstruct_picture(model, colors, mask)
    assert made.kind == "chair" and made.silhouette_iou > 0.8 and bodies(made.surface) >= 3
    assert torch.allclose(made.surface.colors.mean(0), torch.tensor([0.15, 0.38, 0.23]), atol=0.08), "the picture's"
    unknown = model.known_codes._replace(output=model.known_codes.output + 100)
    lump = reconstruct_picture(model._replace(known_codes=unknown), colors, mask)
    assert lump.warning and bodies(lump.surface) < 3, "other things get the predicted shape"


def test_generated_shapes_of_a_training_set_become_templates(model: Model, tmp_path) -> None:
    make_shards(DatasetConfig(tmp_path, "lamp", layout="around", procedural=8, test=1, val=1, shards=True))
    dataset = load_dataset("around", tmp_path, "lamp", "train")
    found = learn_templates(model.method, dataset)
    assert [f"lamp_{number:05d}" for number in found.numbers[0]] == list(dataset.object_names)
    assert torch.allclose(found.axes[1:] @ found.axes[1:].T, torch.eye(len(found.axes) - 1), atol=1e-4)
    others = dataclasses.replace(dataset, object_names=tuple(f"mine {name}" for name in dataset.object_names))
    assert learn_templates(model.method, others) is None


def test_long_edges_are_divided_and_sharp_ones_stay_sharp() -> None:
    box = trimesh.creation.box((1.0, 0.6, 0.02))
    vertices, faces = divide(torch.tensor(box.vertices).float(), torch.tensor(box.faces), 0.1)
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(box.volume, rel=1e-4)
    assert mesh.edges_unique_length.max() <= 0.1
    sharp = sharpen(Surface(vertices, faces, vertices.abs()))
    normals = nmr.vertex_normals(sharp.vertices, sharp.faces)
    assert torch.allclose(normals.abs().amax(1), torch.ones(len(normals)), atol=1e-4), "along the axes"
    assert torch.equal(sharp.colors, sharp.vertices.abs()) and torch.equal(sharp.vertices[sharp.faces], vertices[faces])


def test_edges_are_rounded_and_flat_parts_stay() -> None:
    box = trimesh.creation.box((1.0, 0.6, 0.4))
    vertices, faces = divide(torch.tensor(box.vertices).float(), torch.tensor(box.faces), 0.05)
    rounded = smooth(vertices, faces)
    volume = trimesh.Trimesh(rounded.numpy(), faces.numpy(), process=False).volume
    assert volume == pytest.approx(box.volume, rel=0.03)
    top = rounded[(vertices[:, :2].abs() < 0.15).all(1) & (vertices[:, 2] > 0)]
    assert len(top) > 5 and torch.allclose(top[:, 2], torch.tensor(0.2), atol=1e-3)
    corner = torch.tensor([0.5, 0.3, 0.2])
    assert 0.005 < float((rounded - corner).norm(dim=1).min()) < 0.1
