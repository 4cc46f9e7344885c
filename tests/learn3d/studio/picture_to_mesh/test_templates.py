"""Pictures become generated shapes with the same outline."""

from __future__ import annotations

import copy
import dataclasses
import io
import json

import numpy as np
import pytest
import stub_work
import torch
import trimesh
from painted import seen
from PIL import Image, ImageDraw

import nmr
from learn3d import tasks
from learn3d.data.layouts import load_dataset
from learn3d.pictures import Surface, photograph
from learn3d.studio.make_data.render import DatasetConfig, make_shards
from learn3d.studio.picture_to_mesh import make
from learn3d.studio.picture_to_mesh.coloring import clash
from learn3d.studio.picture_to_mesh.fit import Target, frame_view
from learn3d.studio.picture_to_mesh.make import (
    Model,
    load_model,
    reconstruct_guesses,
    reconstruct_picture,
)
from learn3d.studio.picture_to_mesh.options import DEFAULTS
from learn3d.studio.picture_to_mesh.smoothing import divide, smooth
from learn3d.studio.picture_to_mesh.templates import (
    MIRROR,
    Candidates,
    bend,
    bend_best,
    compare_lines,
    learn_templates,
    likeness,
    spread_out,
    stretch,
    template,
)
from learn3d.studio.picture_to_mesh.write import mesh_bytes


@pytest.fixture(scope="module")
def model() -> Model:
    return load_model(None)


def picture(category: str, number: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = template(category, number)
    camera = nmr.LookAt.from_angles(2.7, 20.0, [35.0], half_fov_deg=15.0)
    colors, mask = photograph(
        vertices * torch.tensor([1.1, 1.0, 0.95]), faces, (0.2, 0.5, 0.3), camera, image_size=128
    )
    return colors[0], mask[0]


def bodies(surface: Surface) -> int:
    # it merges equal vertices
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy())
    return mesh.body_count if mesh.volume > 0 else 0  # below 0: it is inside out


def test_lines_inside_the_same_outline_tell_a_shape() -> None:
    panel = trimesh.creation.box((0.8, 0.8, 0.1))
    plain, crossed = (panel.copy(), panel.copy())
    bar = trimesh.creation.box((0.7, 0.1, 0.1)).apply_translation((0, 0, 0.1))
    crossed = trimesh.util.concatenate([crossed, bar])
    shapes = [torch.tensor(each.vertices).float() for each in (plain, crossed)]
    faces = [torch.tensor(each.faces) for each in (plain, crossed)]
    view = frame_view(shapes[1], torch.tensor([180.0, 180.0]), torch.tensor([20.0, 20.0]))
    for number in range(2):
        own = view.select(torch.tensor([number]))
        target = seen(shapes[number], faces[number], (0.2, 0.5, 0.3), own, lights=None)
        found = Candidates(shapes, faces, ["panel", "panel"], view, torch.zeros(2))
        lines = compare_lines(found, target, DEFAULTS.match)
        assert int(lines.argmin()) == number
        ((made, _),) = bend_best(found, target)
        assert np.ptp(made.vertices.numpy(), axis=0).max() == pytest.approx(1)
        assert made.iou > 0.9, "the view grows with the shape"


def test_a_template_is_found_by_its_code_and_fitted_to_the_outline(model: Model) -> None:
    for kind, category in enumerate(model.categories):
        number = int(model.templates.numbers[kind, 8])
        colors, mask = picture(category, number)
        code = model.method.encode(torch.from_numpy(model.prepare(colors, mask))[None])[0]
        bonus = torch.zeros(len(model.categories))
        names, scores = model.templates.nearest(code.float(), model.categories, bonus, 128)
        assert (category, number) in names and (scores.diff() <= 0).all()
        bonus[kind] = 9
        favoured, _ = model.templates.nearest(code.float(), model.categories, bonus, 128)
        assert {name for name, _ in favoured} == {category}
    made = reconstruct_picture(
        model, *(shown := picture("chair", int(model.templates.numbers[2, 7])))
    )
    assert made.kind == "chair" and made.silhouette_iou > 0.8 and bodies(made.surface) >= 3
    assert torch.allclose(
        made.surface.colors.mean(0), torch.tensor([0.15, 0.38, 0.23]), atol=0.08
    ), "the picture's"
    unknown = model.known_codes._replace(judge=copy.deepcopy(model.known_codes.judge))
    unknown.judge.layers[-1].bias[-1] += 100
    doubted = reconstruct_picture(model._replace(known_codes=unknown), *shown)
    assert "none of airplane, car, chair" in doubted.warning
    assert doubted.kind == "chair" and bodies(doubted.surface) >= 3, "the mesh comes first"
    unknown.judge.layers[-1].bias[-2] += 200
    blind = dataclasses.replace(DEFAULTS, match=dataclasses.replace(DEFAULTS.match, kind=0.0))
    doubted = reconstruct_picture(model._replace(known_codes=unknown), *shown, options=blind)
    assert doubted.kind == "chair" and "may also be of the kind table" in doubted.warning


def test_templates_have_no_boxes_on_their_roofs() -> None:
    bare, loaded = (template("car", 0, loads=loads)[0] for loads in (False, True))
    assert len(bare) < len(loaded)


def test_a_table_gets_the_slanted_legs_and_the_round_top_of_a_picture() -> None:
    shape = trimesh.creation.box((0.9, 0.06, 0.5)).apply_translation((0, 0.3, 0))
    legs = [trimesh.creation.box((0.06, 0.6, 0.06)) for _ in range(2)]
    legs = [leg.apply_translation((x, 0, 0)) for leg, x in zip(legs, (-0.35, 0.35), strict=True)]
    shape = trimesh.util.concatenate([shape.subdivide().subdivide(), *legs])
    vertices, faces = torch.tensor(shape.vertices).float(), torch.tensor(shape.faces)
    view = frame_view(vertices, torch.tensor([0.0]), torch.tensor([0.0]))
    x, y, z = vertices.unbind(1)
    wanted = torch.stack([x * (1 - 0.6 * y), y - 0.3 * (y > 0.2) * x**2, z], 1)
    outline = view.silhouettes(wanted, faces)[0]
    found = Candidates([vertices], [faces], ["table"], view, torch.zeros(1))
    bent = bend(found, outline, DEFAULTS.match)
    before, after = (
        float(each.views.ious(each.shapes, each.faces, outline).detach()) for each in (found, bent)
    )
    assert before < 0.5 and after > 0.82
    whole = bend(found, outline, dataclasses.replace(DEFAULTS.match, bent_cost=1.0))
    costs = [-float(each.prior.detach()) for each in (bent, whole)]
    assert costs[0] == pytest.approx(costs[1] / 2) and costs[1] > 0.01, "half of it ranks"
    assert torch.equal(bent.shapes[0], whole.shapes[0]), "the shape is bent at its full cost"
    outline[:, 40:] = 0  # a picture of a part does not make the shape lop-sided
    (lame,) = bend(found, outline, DEFAULTS.match).shapes
    assert torch.cdist(lame @ MIRROR, lame).min(1).values.max() < 1e-3


def test_a_stretched_template_fits_better_and_costs() -> None:
    box = trimesh.creation.box((0.5, 0.4, 0.3))
    vertices, faces = torch.tensor(box.vertices).float(), torch.tensor(box.faces)
    view = frame_view(vertices, torch.tensor([30.0]), torch.tensor([20.0]))
    outline = view.silhouettes(vertices * torch.tensor([1.2, 0.8, 1.0]), faces)[0]
    found = Candidates([vertices], [faces], ["box"], view, torch.zeros(1))
    made = stretch(found, outline, DEFAULTS.match)
    before, after = (
        float(each.views.ious(each.shapes, each.faces, outline).detach()) for each in (found, made)
    )
    assert after > before + 0.05
    logs = (made.shapes[0].detach().amax(0) / vertices.amax(0)).log()
    unequal = float((logs - logs.mean()).square().sum())
    assert unequal > 1e-3
    assert float(made.prior.detach()) == pytest.approx(
        -DEFAULTS.match.stretching * unequal, rel=1e-3
    )


@pytest.mark.parametrize("roll_deg", [45.0, -60.0])
def test_an_airplane_that_is_turned_in_its_picture_is_found(model: Model, roll_deg: float) -> None:
    shown = np.dstack(picture("airplane", int(model.templates.numbers[0, 30])))
    turned = Image.fromarray(shown).rotate(roll_deg, Image.Resampling.BICUBIC, expand=True)
    turned = np.asarray(turned)
    made = reconstruct_picture(model, np.ascontiguousarray(turned[..., :3]), turned[..., 3])
    assert made.kind == "airplane" and made.silhouette_iou > 0.75
    apart = (float(made.view.roll_deg) - roll_deg + 180) % 360 - 180
    assert abs(apart) <= 20


@pytest.mark.parametrize("lines", [False, True])
def test_the_front_of_a_drawn_car_is_not_its_side(model: Model, lines: bool) -> None:
    """A side view that was predicted fits the outline well, but a level front view fits it better."""
    image = Image.new("RGBA", (240, 240))
    draw, black, clear = ImageDraw.Draw(image), (0, 0, 0, 255), (0, 0, 0, 0)
    draw.polygon([(46, 40), (194, 40), (216, 96), (216, 182), (24, 182), (24, 96)], black)
    draw.polygon([(48, 56), (192, 56), (196, 92), (44, 92)], clear)
    if lines:
        draw.rectangle((40, 108, 200, 168), clear)
    for x in (64, 176):
        draw.ellipse((x - 16, 120, x + 16, 152), black if lines else clear)
    for x in (24, 184):
        draw.rectangle((x, 182, x + 32, 200), black)
    drawn = np.asarray(image)
    made = reconstruct_picture(model, np.ascontiguousarray(drawn[..., :3]), drawn[..., 3].copy())
    assert made.kind == "car" and made.warning is None
    assert abs(made.azimuth_deg % 180 - 90) > 70, "the front or the back"
    assert made.surface.colors.min() > 0.45, "grey, as black shows no shape"
    assert made.surface.colors.max() > 0.9, "with white windows"


def test_a_kind_counts_with_the_logarithm_of_its_probability(model: Model, monkeypatch) -> None:
    shown, given = picture("sofa", int(model.templates.numbers[4, 7])), []
    original = make.find_candidates

    def find(templates, categories, predicted, outline, bonus, *others) -> Candidates:
        given.append(dict(zip(categories, bonus.tolist(), strict=True)))
        return original(templates, categories, predicted, outline, bonus, *others)

    monkeypatch.setattr(make, "find_candidates", find)
    for of_chair in (0.55, 0.98):
        chances = torch.tensor([0, 0, of_chair, 0, 0.99 - of_chair, 0, 0.01])
        monkeypatch.setattr(Model, "chances", lambda *_, chances=chances: chances)
        reconstruct_picture(model, *shown)
    weight = DEFAULTS.match.kind
    unsure, sure = ({kind: value / weight for kind, value in given[k].items()} for k in (0, -1))
    assert 0 < unsure["chair"] - unsure["sofa"] < 0.5 < 4 < sure["chair"] - sure["sofa"] < 5
    assert -5 < sure["lamp"] <= sure["sofa"], "what is least probable is still possible"


def test_guesses_are_good_and_different() -> None:
    boxes = torch.zeros(4, 8, 8, 8, dtype=torch.bool)
    boxes[:2, :4], boxes[2, 2:6], boxes[3, 4:] = True, True, True
    scores = torch.tensor([1.0, 0.99, 0.95, 0.9])
    assert spread_out(scores, boxes, 3, 0.3) == [0, 3, 2]
    assert spread_out(scores, boxes, 9, 0.0) == [0, 1, 2, 3]


def test_colours_that_are_not_mirror_images_tell_a_wrong_camera() -> None:
    box = trimesh.creation.box((0.8, 0.5, 0.3))
    vertices, faces = divide(torch.tensor(box.vertices).float(), torch.tensor(box.faces), 0.1)
    centres = vertices[faces].mean(1)
    paint = np.where(centres[:, :1].abs() > 0.2, [[0.9, 0.1, 0.1]], [[0.1, 0.9, 0.1]])
    view = frame_view(vertices, torch.tensor([0.0]), torch.tensor([10.0]))
    target = seen(vertices, faces, paint, view)
    right = clash((vertices, faces), view, target, MIRROR)
    others = target.pixels[[2, 1, 0, 3]]
    lop_sided = Target(torch.where(torch.arange(256) < 128, target.pixels, others))
    assert right < 0.05 < 0.2 < clash((vertices, faces), view, lop_sided, MIRROR)


def test_colours_and_edges_rank_candidates() -> None:
    cube = trimesh.creation.box((0.6, 0.6, 0.6))
    vertices, faces = divide(torch.tensor(cube.vertices).float(), torch.tensor(cube.faces), 0.1)
    view = frame_view(vertices, torch.tensor([0.0, 90.0]), torch.tensor([10.0, 10.0]))
    target = seen(vertices, faces, (0.2, 0.5, 0.3), view.select(torch.tensor([0])))
    others = target.pixels[[2, 0, 1, 3]]  # the left half, of another colour
    target = Target(torch.where(torch.arange(256) < 128, target.pixels, others))
    prior = torch.tensor([0.01, 0.0])
    found = Candidates([vertices] * 2, [faces] * 2, ["mirrored", "hidden"], view, prior)
    for colors, kind in ((0.0, "mirrored"), (DEFAULTS.match.colors, "hidden")):
        match = dataclasses.replace(DEFAULTS.match, colors=colors)
        options = dataclasses.replace(DEFAULTS, match=match)
        assert [each[1] for each in bend_best(found, target, options=options)] == [kind]
    outline = target.outline()
    holed = outline * (torch.arange(64) % 8 < 4)
    alike, apart = (likeness(found, each, DEFAULTS.match)[0] for each in (outline, holed))
    ious = view.ious(vertices, faces, outline)[0], view.ious(vertices, faces, holed)[0]
    assert alike == pytest.approx(float(ious[0]), abs=0.01) and apart < ious[1] - 0.05


def test_guesses_differ_and_a_known_category_is_obeyed(model: Model) -> None:
    shown = picture("chair", int(model.templates.numbers[2, 7]))
    first, *others = reconstruct_guesses(model, *shown, guesses=3)
    with pytest.raises(ValueError, match="guesses must be at least 1, got 0"):
        next(reconstruct_guesses(model, *shown, guesses=0))
    assert first.kind == "chair" and 1 <= len(others) <= 2
    grids = [
        nmr.voxelize(0.99 * made.surface.vertices + 0.5, made.surface.faces)
        for made in (first, *others)
    ]
    assert all(nmr.metrics.voxel_iou(grids[0], grid) < 0.9 for grid in grids[1:])
    assert all(made.silhouette_iou > 0.6 for made in others), "each explains the outline"
    table = reconstruct_picture(model, *shown, category="table")
    assert table.kind == "table" and table.warning is None
    with pytest.raises(ValueError, match=r"trained on airplane, car.*not on 'boat'"):
        reconstruct_picture(model, *shown, category="boat")


def test_generated_shapes_of_a_training_set_become_templates(
    model: Model, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(tasks, "run_tasks", stub_work.run_tasks_here)
    make_shards(
        DatasetConfig(tmp_path, "lamp", layout="around", procedural=8, test=1, val=1, shards=True)
    )
    dataset = load_dataset("around", tmp_path, "lamp", "train")
    found = learn_templates(model.method, dataset)
    assert [f"lamp_{number:05d}" for number in found.numbers[0]] == list(dataset.object_names)
    assert torch.allclose(
        found.axes[1:] @ found.axes[1:].T, torch.eye(len(found.axes) - 1), atol=1e-4
    )
    others = dataclasses.replace(
        dataset, object_names=tuple(f"mine {name}" for name in dataset.object_names)
    )
    assert learn_templates(model.method, others) is None


def test_long_edges_are_divided_with_the_values_at_their_ends() -> None:
    box = trimesh.creation.box((1.0, 0.6, 0.02))
    places = torch.tensor(box.vertices).float()
    values, faces = divide(torch.cat([places, 5 - places], 1), torch.tensor(box.faces), 0.1)
    vertices, further = values.split(3, 1)
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(box.volume, rel=1e-4)
    assert mesh.edges_unique_length.max() <= 0.1
    assert torch.allclose(further, 5 - vertices, atol=1e-5)


@pytest.mark.parametrize("kind", ["glb", "obj", "ply"])
def test_a_painted_mesh_is_welded_smooth_and_names_its_program(model: Model, kind: str) -> None:
    made = reconstruct_picture(model, *picture("table", int(model.templates.numbers[5, 8])))
    content = mesh_bytes(made.surface, kind, "desk")
    assert b"learn3d" in content[:2000] and b"trimesh" not in content
    mesh = trimesh.load(io.BytesIO(content), file_type=kind, force="mesh", process=False)
    # a closed mesh with V - 2 = F / 2 for each of its parts: no vertex is there twice
    assert mesh.is_watertight and mesh.euler_number == 2 * mesh.body_count
    assert mesh.edges_unique_length.max() < 0.026
    normals = mesh.vertex_normals[mesh.faces]
    assert np.allclose(np.linalg.norm(normals, axis=2), 1, atol=1e-3)
    assert np.mean((normals * mesh.face_normals[:, None]).sum(2) > 0) > 0.99, "outwards"
    if kind == "glb":
        tree = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
        assert tree["meshes"][0]["name"] == "desk"
        assert {view["target"] for view in tree["bufferViews"]} == {34962, 34963}


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
