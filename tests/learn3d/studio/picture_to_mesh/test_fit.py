"""Pictures without a camera: the camera, the shape and the colours that are fitted to them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
import trimesh
from painted import seen
from PIL import Image
from scipy.ndimage import distance_transform_edt

import nmr
from learn3d.data.dataset import DatasetInfo
from learn3d.data.layouts import load_dataset
from learn3d.methods import create_method
from learn3d.methods.mesh_method import MeshMethod
from learn3d.networks.encoders import centre
from learn3d.presets import PRESETS
from learn3d.studio.picture_to_mesh.coloring import _alike, color_mesh
from learn3d.studio.picture_to_mesh.export import export
from learn3d.studio.picture_to_mesh.familiarity import FAR, KnownCodes, known_codes, learn_kinds
from learn3d.studio.picture_to_mesh.fit import (
    AZIMUTHS,
    CENTRED_SIZE,
    Target,
    View,
    belief,
    find_view,
    fit,
    frame_view,
    predict,
)
from learn3d.studio.picture_to_mesh.make import load_model, recognize, reconstruct_picture
from learn3d.studio.picture_to_mesh.options import DEFAULTS
from learn3d.studio.picture_to_mesh.reconstruction import cut_out_pictures
from learn3d.studio.picture_to_mesh.smoothing import divide, joined
from learn3d.studio.picture_to_mesh.write import Reconstruction
from nmr.losses import laplacian_loss, smoothness_loss


def arrow() -> tuple[torch.Tensor, torch.Tensor]:
    """A test shape, symmetric about z = 0: a sphere, stretched to a point at x < 0 and bent up at x > 0."""
    vertices, faces = (part.clone() for part in nmr.icosphere(3))
    vertices = vertices.float() * torch.tensor([0.3, 0.12, 0.25])
    vertices[:, 0] -= 0.25 * (-vertices[:, 0] / 0.3).clamp(min=0) ** 4
    vertices[:, 1] += 0.35 * (vertices[:, 0] / 0.3).clamp(min=0) ** 4
    return vertices, faces


@pytest.fixture(scope="module")
def method() -> MeshMethod:
    """A method that predicts the arrow, made longer by its code."""
    settings = dataclasses.replace(PRESETS["many-views-around"].settings, symmetry="z")
    method = create_method(
        settings, DatasetInfo(24, inverted=True), device="cpu", precision="fp32", seed=0
    )
    vertices, _ = arrow()
    base, stretch = vertices[None], torch.tensor([1.0, 0.0, 0.0])
    method.encode = lambda images: torch.ones(len(images), 4)
    generator = method.generator
    generator.forward = lambda codes: base * (1 + 0.5 * (codes[:, :1, None] - 1) * stretch)
    return method


def framed_mask(
    vertices: torch.Tensor, faces: torch.Tensor, azimuth: float, elevation: float
) -> torch.Tensor:
    cameras = nmr.LookAt.from_angles(3.5, [elevation], [azimuth], half_fov_deg=12.0)
    return centre(nmr.render_silhouette(vertices, faces, cameras, image_size=128)[:, None].float())[
        :, :, ::2, ::2
    ][0, 0]


def test_views_are_framed() -> None:
    vertices, _ = arrow()
    azimuth, elevation = torch.tensor([0.0, 50.0, -120.0]), torch.tensor([0.0, 30.0, 60.0])
    many = (vertices + torch.tensor([0.1, -0.2, 0.05])).expand(3, -1, -1)
    view = frame_view(many, azimuth, elevation)
    seen = view.cameras().transform(many)[..., :2]
    low, high = seen.amin(1), seen.amax(1)
    assert torch.allclose((low + high) / 2, torch.zeros(3, 2), atol=1e-3)
    assert torch.allclose((high - low).amax(1), torch.full((3,), 2 * CENTRED_SIZE), atol=2e-3)
    axes = view.axes()
    assert torch.allclose(axes @ axes.transpose(1, 2), torch.eye(3).expand(3, 3, 3), atol=1e-6)
    looks = view.cameras().projection().matrix[:, :, :3].float()  # y is down
    assert torch.allclose(axes, looks * torch.tensor([[1.0], [-1.0], [1.0]]), atol=1e-5)


@pytest.mark.parametrize(("azimuth", "elevation"), [(35.0, 20.0), (-100.0, 5.0), (110.0, 40.0)])
def test_the_camera_is_found(azimuth: float, elevation: float) -> None:
    view, iou = find_view(*arrow(), framed_mask(*arrow(), azimuth, elevation))
    assert iou > 0.88
    apart = (float(view.azimuth_deg) - azimuth + 180) % 360 - 180
    assert abs(apart) < 12 and abs(float(view.elevation_deg) - elevation) < 12


def test_probabilities_decide_between_views_with_one_outline() -> None:
    mask = framed_mask(*arrow(), 0.0, 0.0)  # from 0 and from 180 degrees outlines are mirror images
    mask = torch.maximum(mask, mask.flip(1))
    for azimuth in (7.5, 172.5):
        probabilities = torch.full((AZIMUTHS,), 1e-3)
        probabilities[int((azimuth + 180) // 15)] = 1.0
        view, _ = find_view(*arrow(), mask, probabilities)
        assert abs(float(view.azimuth_deg) - azimuth) < 25


def test_belief_is_interpolated_between_the_centres_of_cells() -> None:
    probabilities = torch.rand(AZIMUTHS, generator=torch.Generator().manual_seed(0))
    logs = probabilities.clamp(min=1e-4).log()
    centres = -172.5 + 15 * torch.arange(AZIMUTHS)
    torch.testing.assert_close(belief(centres, probabilities, 2.0), 2 * logs)
    torch.testing.assert_close(
        belief(centres + 7.5, probabilities, 2.0), logs + logs.roll(-1), msg="also at 180 degrees"
    )
    assert belief(centres, None).tolist() == [0] * AZIMUTHS


@pytest.mark.parametrize(
    ("weight", "size"),
    [
        ("pull", lambda fitted, start, edges: (fitted - start).square().sum()),
        ("stiffness", lambda fitted, start, edges: laplacian_loss(fitted - start, edges)),
        ("smoothness", lambda fitted, start, edges: smoothness_loss(fitted, edges)),
    ],
)
def test_every_weight_of_the_fit_counts(method: MeshMethod, weight: str, size) -> None:
    vertices, faces = arrow()
    mask = framed_mask(vertices * torch.tensor([1.4, 1.0, 1.0]), faces, 20.0, 15.0)
    predicted = predict(method, torch.zeros(4, 64, 64, dtype=torch.uint8), mask)
    free, held = (
        fit(
            method,
            predicted,
            mask,
            options=dataclasses.replace(DEFAULTS.fit, **{weight: factor}),
        ).vertices
        for factor in (0.0, 10 * getattr(DEFAULTS.fit, weight))
    )
    assert size(held, vertices, method.edges) < 0.9 * size(free, vertices, method.edges)


def test_the_shape_comes_closer_to_the_outline_and_stays_symmetric(method: MeshMethod) -> None:
    vertices, faces = arrow()
    longer = vertices * torch.tensor([1.4, 1.0, 1.0]) + 0.04 * torch.tensor([0.0, 1.0, 0.0]) * (
        vertices[:, :1] > 0.2
    )
    mask, said = framed_mask(longer, faces, 20.0, 15.0), []
    image = torch.zeros(4, 64, 64, dtype=torch.uint8)
    predicted = predict(method, image, mask)
    found = fit(method, predicted, mask, lambda text, part: said.append(part))
    assert predicted.shape.iou < found.iou and found.iou > 0.91
    assert torch.allclose(
        method.generator.symmetrized(found.vertices[None])[0], found.vertices, atol=1e-5
    )
    assert said == sorted(said) and 0 < said[-1] < 1


def test_colours_of_the_seen_side_are_the_pictures_and_the_others_those_of_the_mirror_image() -> (
    None
):
    vertices, faces = arrow()
    centres = vertices[faces].mean(1)
    # red above, blue below
    paint = np.where(centres[:, 1:2] > 0, [[0.9, 0.1, 0.1]], [[0.1, 0.1, 0.9]])
    view = frame_view(vertices[None], torch.tensor([20.0]), torch.tensor([10.0]))
    picture = seen(vertices, faces, paint, view)
    reflection = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
    surface = color_mesh((vertices, faces), view, picture, reflection)
    _, y, z = surface.vertices.T
    for side in (z < -0.1, z > 0.1):  # the camera stands at z < 0
        for part, wanted in ((y > 0.05, [0.9, 0.1, 0.1]), (y < -0.05, [0.1, 0.1, 0.9])):
            found = surface.colors[side & part].mean(0)
            assert torch.allclose(found, torch.tensor(wanted), atol=0.12), (found, wanted)
    alone = color_mesh((vertices, faces), view, picture)
    assert (
        torch.isfinite(alone.colors).all() and alone.colors.min() >= 0 and alone.colors.max() <= 1
    )


def test_hidden_parts_have_the_colours_of_equal_ones() -> None:
    box, faces = map(
        torch.tensor, (trimesh.creation.box((0.1, 0.4, 0.1)).vertices, trimesh.creation.box().faces)
    )
    # two legs, and another part near
    places = torch.tensor([(-0.3, -0.2, -0.3), (-0.3, -0.2, 0.3), (0.0, 0.2, 0.3)])
    vertices = (box + places[:, None]).flatten(0, 1)
    faces = torch.cat([faces, faces + 8, faces + 16])
    clear = 1.0 * (np.arange(24) // 8 != 1)
    colors = np.arange(24)[:, None] // 8 + np.zeros((1, 3))
    normals = np.zeros((24, 3))
    neighbours = joined(faces.numpy(), 24)
    alike = _alike(colors, clear, vertices.numpy(), normals, neighbours, DEFAULTS.color)
    assert alike[:, 0].tolist() == [0] * 16 + [2] * 8, (
        "the leg has the other leg's, not the near part's"
    )


def test_hidden_sides_have_the_colours_at_their_height() -> None:
    """A house, half glass above half paint, that is seen from one side only."""
    box = trimesh.creation.box((0.8, 0.6, 0.4))
    vertices, faces = divide(torch.tensor(box.vertices).float(), torch.tensor(box.faces), 0.04)
    high = vertices[faces].mean(1)[:, 1:2] > 0
    paint = np.where(high, [[0.1, 0.2, 0.8]], [[0.8, 0.2, 0.1]])
    view = frame_view(vertices[None], torch.tensor([0.0]), torch.tensor([5.0]))
    surface = color_mesh((vertices, faces), view, seen(vertices, faces, paint, view))
    behind = (surface.vertices[:, 2] > 0.19) & (surface.vertices[:, 0].abs() < 0.3)
    for side, wanted in ((surface.vertices[:, 1] > 0.1, 2), (surface.vertices[:, 1] < -0.1, 0)):
        found = surface.colors[behind & side].mean(0)
        assert found.argmax() == wanted and found[wanted] > 2 * found[2 - wanted], found


def test_the_line_around_a_drawing_stays_where_it_is_seen() -> None:
    """A red board on a thin leg; the drawing has a black line around it, and the leg is black."""
    board = divide(*map(torch.tensor, _box(0.8, 0.5, 0.2)), 0.05)
    leg = divide(*map(torch.tensor, _box(0.06, 0.3, 0.06)), 0.05)
    leg = leg[0] - torch.tensor([0.0, 0.4, 0.0]), leg[1] + len(board[0])
    vertices, faces = torch.cat([board[0], leg[0]]).float(), torch.cat([board[1], leg[1]])
    view = frame_view(vertices[None], torch.tensor([0.0]), torch.tensor([0.0]))
    pixels = seen(vertices, faces, (0.9, 0.1, 0.1), view).pixels
    line = distance_transform_edt(pixels[3] > 0.5) < 12
    pixels[:3, torch.from_numpy(line)] = 0
    surface = color_mesh((vertices, faces), view, Target(pixels))
    red, (x, y, z) = surface.colors[:, 0], surface.vertices.T
    back, front = z > 0.09, z < -0.09
    assert red[back].min() > 0.6, "hidden parts have no line"
    side = front & (y.abs() < 0.2)
    assert red[side & ((x - 0.37).abs() < 0.015)].mean() < 0.4, "the line"
    assert red[side & (x.abs() < 0.3)].mean() > 0.6
    assert red[y < -0.35].max() < 0.3, "all of the leg"


def _box(*sides: float) -> tuple[np.ndarray, np.ndarray]:
    box = trimesh.creation.box(sides)
    return np.array(box.vertices), np.array(box.faces)


def test_a_picture_without_a_seen_vertex_still_has_colours() -> None:
    vertices, faces = arrow()
    level = torch.zeros(1)
    view = View(level, level, torch.tensor([3.0]), torch.zeros(1, 2), level)
    surface = color_mesh((vertices, faces), view, Target(torch.zeros(4, 64, 64)))
    assert surface.colors.isfinite().all()


def test_a_picture_is_reconstructed_with_and_without_the_fit(finished_run) -> None:
    model, size = load_model(finished_run), 128
    rows, columns = np.ogrid[:size, :size]
    mask = (255 * (((rows - 60) / 20) ** 2 + ((columns - 64) / 50) ** 2 < 1)).astype(np.uint8)
    colors = np.full((size, size, 3), (200, 120, 40), np.uint8)
    fitted, plain = (
        reconstruct_picture(model, colors, mask, refined=refined) for refined in (True, False)
    )
    assert isinstance(fitted, Reconstruction) and fitted.silhouette_iou > 0.6
    assert torch.allclose(
        fitted.surface.colors.mean(0), torch.tensor([200, 120, 40]) / 255, atol=0.03
    )
    assert (
        plain.surface.colors is None
        and plain.silhouette_iou is None
        and plain.kind is plain.warning is None
    )


def test_unknown_things_are_warned_of(finished_run, tiny_folder, tmp_path) -> None:
    assert load_model(finished_run).known_codes is None
    export(finished_run, tmp_path / "small.safetensors")
    model = load_model(tmp_path / "small.safetensors")
    images = load_dataset("kato", tiny_folder, "airplane", "train").batch(torch.arange(20)).images
    other = model._replace(known_codes=KnownCodes(-model.known_codes.kinds))
    assert all(model.chances(image).tolist() == [1, 0] for image in images)
    assert all(other.chances(image).tolist() == [0, 1] for image in images)
    assert recognize(model, model.chances(images[0])) == (None, None), "it knows only one category"
    _, warning = recognize(other, other.chances(images[0]))
    assert warning.startswith("this may be none of airplane: tell its kind")


def test_pictures_of_other_things_teach_what_to_warn_of(
    finished_run, tiny_set, tmp_path, capsys
) -> None:
    rng = np.random.default_rng(0)
    rows, columns = np.ogrid[:64, :64]
    stored, kinds = [], np.arange(90) % 3
    for kind in kinds:  # discs, squares and triangles
        far = [np.hypot(rows - 32, columns - 32), np.maximum(abs(rows - 32), abs(columns - 32))]
        far.append(abs(columns - 32) + (rows - 10) / 2)
        inside = 255 * (far[kind] < rng.uniform(15, 25))
        stored.append(rng.uniform(0, 1, (4, 1, 1)) * inside)
        stored[-1][3] = inside
    images, kinds = torch.from_numpy(np.stack(stored).astype(np.uint8)), torch.from_numpy(kinds)
    judge = learn_kinds(images[:60].repeat(4, 1, 1, 1), kinds[:60].repeat(4), True)
    known = KnownCodes(torch.full((2, 1, 512), (1 - FAR) / 512**0.5), judge)  # no kind is nearer
    chances = torch.stack([known.probabilities(image, torch.ones(512)) for image in images[60:]])
    assert torch.allclose(chances.sum(1), torch.ones(30))
    assert (chances.argmax(1) == kinds[60:]).float().mean() > 0.9
    first, again = (learn_kinds(images[:9], kinds[:9], True).state_dict() for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first), "bit-identical"
    model = load_model(finished_run)
    with pytest.raises(ValueError, match="no PNG file in"):
        cut_out_pictures(model, tmp_path)
    image = tiny_set.images[0]
    Image.fromarray(np.concatenate([255 - image[:3], image[3:]]).transpose(1, 2, 0)).save(
        tmp_path / "other.png"
    )
    Image.new("RGBA", (9, 9)).save(tmp_path / "empty.png")
    with pytest.raises(ValueError, match=r"empty\.png: .* no pixel above half"):
        cut_out_pictures(model, tmp_path)
    (tmp_path / "empty.png").unlink()
    export(finished_run, tmp_path / "small.safetensors", others=cut_out_pictures(model, tmp_path))
    assert "learning other things (1 pictures)" in capsys.readouterr().err
    known = load_model(tmp_path / "small.safetensors").known_codes
    assert known.judge.layers[-1].out_features == 2


def test_a_picture_is_taken_for_the_nearest_kind(finished_run, tiny_folder) -> None:
    method = load_model(finished_run).method
    dataset = load_dataset("kato", tiny_folder, "airplane", "train")
    kinds = np.arange(dataset.num_objects)  # each object one kind
    dataset = dataclasses.replace(dataset, class_ids=kinds, class_names=tuple("abc"))
    known = known_codes(method, dataset)
    assert len(known.kinds) == 3 and known.judge is None
    batch = dataset.batch(torch.arange(len(dataset)))
    pairs = zip(batch.images, method.encode(batch.images), strict=True)
    found = [int(known.probabilities(*pair).argmax()) for pair in pairs]
    assert np.mean(np.equal(found, batch.class_ids.numpy())) > 0.9
