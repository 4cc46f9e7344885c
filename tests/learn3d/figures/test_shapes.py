"""Comparison grids, interpolations and profiles over views, with methods whose shapes are known beforehand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

import nmr
from learn3d.data.dataset import ViewDataset
from learn3d.data.poses import LookAtPoses
from learn3d.evaluation import evaluate
from learn3d.figures import interpolation, paper, polar
from learn3d.figures.grids import comparison_grid, spread_views
from learn3d.figures.interpolation import interpolation_strip, morph
from learn3d.figures.runs import Run, encode
from learn3d.methods import Grids, Meshes, Method
from learn3d.pictures.sheets import HEADER, MARGIN, TILE, magnify, natural_colors
from learn3d.pictures.surfaces import Surface, azimuths_deg, common_zoom, draw_surface, orbit

STEP = TILE + MARGIN
SPHERE, FACES = nmr.icosphere(2)


class Ellipsoids(Method):
    """As wide and as high as the mask; as deep as its centre is red, which differs from view to view."""

    def __init__(self, scale: float = 1.0, depth_of_red: float = 0.7) -> None:
        self.networks, self.optimizers = {}, {}
        self.device, self.precision, self.image_size = torch.device("cpu"), "fp32", 64
        self.scale, self.depth_of_red = scale, depth_of_red

    def create_networks(self):
        raise NotImplementedError

    def create_optimizers(self):
        raise NotImplementedError

    def training_step(self, batch, step):
        raise NotImplementedError

    def encode(self, images: Tensor) -> Tensor:
        mask, red = images[:, 3] > 127, images[:, 0, 32, 32].float() / 255
        width, height = (mask.any(dim=axis).float().mean(dim=1) for axis in (1, 2))
        return 0.5 * self.scale * torch.stack([width, height, 0.2 + self.depth_of_red * red], dim=1)

    def decode(self, codes: Tensor) -> Meshes | Grids:
        return Meshes(SPHERE * codes[:, None], FACES)


class GridEllipsoids(Ellipsoids):
    """The same as volumes."""

    def decode(self, codes: Tensor) -> Grids:
        centres = (torch.arange(32) + 0.5) / 32 - 0.5
        points = torch.stack(torch.meshgrid(centres, centres, centres, indexing="ij"), dim=-1)
        return Grids(torch.sigmoid(20 * (1 - (points / codes[:, None, None, None]).norm(dim=-1))))


def shapes(method: Method, dataset: ViewDataset, samples: Tensor) -> list[Surface]:
    return method.decode(method.encode(dataset.batch(samples).images)).surfaces()


def cell(grid: np.ndarray, row: int, column: int, *, top: int, left: int = 0) -> np.ndarray:
    y, x = top + MARGIN + row * STEP, left + MARGIN + column * STEP
    return grid[y : y + TILE, x : x + TILE]


def test_methods_are_drawn_from_the_same_views(tiny_set) -> None:
    samples, methods = torch.tensor([3, 40]), [("large", Ellipsoids()), ("small", GridEllipsoids(0.5))]
    grid = comparison_grid(methods, tiny_set, samples)
    top, left = HEADER, grid.shape[1] - 7 * STEP - MARGIN
    poses = [tiny_set.poses[samples[i : i + 1]] for i in (0, 1)]
    cameras = [orbit(pose, [0, 60, 120, 180, 240, 300]) for pose in poses]
    drawn = [pair for _, method in methods for pair in zip(shapes(method, tiny_set, samples), cameras, strict=True)]
    zoom = common_zoom(drawn, tiny_set.batch(samples).masks)
    assert zoom > 1
    for k, (_, method) in enumerate(methods):
        surface = shapes(method, tiny_set, samples)[1]
        views = draw_surface(surface, orbit(poses[1], [0, 300], zoom=zoom), image_size=TILE)
        assert np.array_equal(cell(grid, 2 + k, 1, top=top, left=left), views[0])
        assert np.array_equal(cell(grid, 2 + k, 6, top=top, left=left), views[1])
    picture = magnify(natural_colors(tiny_set.images[samples.numpy()]), zoom)[0]
    resized = np.asarray(Image.fromarray(picture).resize((TILE,) * 2, Image.Resampling.BICUBIC))
    assert np.array_equal(cell(grid, 0, 0, top=top, left=left), resized)


def test_methods_stand_below_each_other(tiny_set) -> None:
    methods = [("large", Ellipsoids()), ("small", Ellipsoids(0.4)), ("nothing", Ellipsoids(0.0))]
    grid = comparison_grid(methods, tiny_set, torch.tensor([3, 40]))
    left = grid.shape[1] - 7 * STEP - MARGIN
    assert grid.shape[0] == HEADER + 6 * STEP + MARGIN
    assert 30 < left < 120  # the labels
    cells = [[cell(grid, row, column, top=HEADER, left=left) for column in range(7)] for row in range(6)]
    ink = (np.array(cells) < 250).mean(axis=(2, 3, 4))
    assert (ink[[0, 3], 0] > 0.05).all() and (ink[[1, 2, 4, 5], 0] == 0).all()  # the input: in the first row alone
    assert (ink[[0, 3], 1:] > 3 * ink[[1, 4], 1:]).all()
    assert (ink[[1, 4], 1:] > 0.005).all()
    assert (ink[[2, 5], 1:] < 0.005).all()


def test_the_truth_is_shown_as_it_was_seen(tiny_set) -> None:
    grid = comparison_grid([("a", Ellipsoids())], tiny_set, torch.tensor([3, 30]), truth=True)
    voxels = tiny_set.convention.to_object(torch.from_numpy(tiny_set.voxels[[0, 1]]).float())
    pose, true = tiny_set.poses[torch.tensor([30])], Grids(voxels).surfaces()
    cameras = [orbit(tiny_set.poses[torch.tensor([i])], [0, 60, 120, 180, 240, 300]) for i in (3, 30)]
    own = shapes(Ellipsoids(), tiny_set, torch.tensor([3, 30]))
    masks = tiny_set.batch(torch.tensor([3, 30])).masks
    zoom = common_zoom([*zip(true, cameras, strict=True), *zip(own, cameras, strict=True)], masks)
    views = draw_surface(true[1], orbit(pose, [0, 60], zoom=zoom), image_size=TILE)
    left = grid.shape[1] - 7 * STEP - MARGIN
    for column in (0, 1):
        assert np.array_equal(cell(grid, 2, 1 + column, top=HEADER, left=left), views[column])
    three = comparison_grid([("a", Ellipsoids()), ("b", Ellipsoids())], tiny_set, torch.tensor([3]), truth=True)
    assert three.shape[0] == HEADER + 3 * STEP + MARGIN
    with pytest.raises(ValueError, match="different labels"):
        comparison_grid([("truth", Ellipsoids())], tiny_set, torch.tensor([3]), truth=True)
    with pytest.raises(ValueError, match="airplane, test has no true voxels to show"):
        comparison_grid(
            [("a", Ellipsoids())], dataclasses.replace(tiny_set, voxels=None), torch.tensor([3]), truth=True
        )


def test_comparisons_need_methods_of_different_names(tiny_set) -> None:
    with pytest.raises(ValueError, match="at least one method"):
        comparison_grid([], tiny_set, torch.tensor([0]))
    with pytest.raises(ValueError, match=r"different labels, got \['a', 'a'\]"):
        comparison_grid([("a", Ellipsoids()), ("a", Ellipsoids())], tiny_set, torch.tensor([0]))


def test_images_for_figures_are_spread_over_objects_and_views(tiny_set) -> None:
    samples = spread_views(tiny_set, 6)
    assert len(set(samples.tolist())) == 6
    assert np.bincount(tiny_set.object_ids[samples.numpy()]).tolist() == [2, 2, 2]
    azimuths = np.sort(azimuths_deg(tiny_set.poses[samples]).numpy() % 360)
    assert np.diff(np.append(azimuths, azimuths[0] + 360)).min() >= 15
    assert torch.equal(samples[:3], spread_views(tiny_set, 3))
    assert sorted(spread_views(tiny_set, 72).tolist()) == list(range(72))
    one_view = tiny_set.select(np.array([0, 24, 48]))
    assert sorted(spread_views(one_view, 3).tolist()) == [0, 1, 2]
    for count in (0, 73):
        with pytest.raises(ValueError, match=f"has 72 images, {count} were asked for"):
            spread_views(tiny_set, count)


def test_a_walk_goes_through_every_code_in_equal_steps() -> None:
    codes = torch.tensor([[0.0, 1.0], [4.0, 1.0], [4.0, -3.0]])
    way = interpolation.walk(codes, 4)
    assert way.shape == (9, 2)
    assert torch.equal(way[::4], codes)
    assert torch.allclose(way.diff(dim=0).norm(dim=1), torch.ones(8))
    loop = interpolation.walk(codes, 4, closed=True)
    assert loop.shape == (12, 2)
    assert torch.equal(loop[:9], way)
    assert torch.allclose(loop[10], (codes[2] + codes[0]) / 2)
    with pytest.raises(ValueError, match="at least two images, got \\[1, 2\\]"):
        interpolation.walk(codes[:1], 4)
    with pytest.raises(ValueError, match="must be at least 1, got 0"):
        interpolation.walk(codes, 0)


@pytest.mark.parametrize("method", [Ellipsoids(), GridEllipsoids()])
def test_a_strip_starts_and_ends_with_the_reconstructions(tiny_set, method) -> None:
    samples, azimuths = torch.tensor([3, 30, 60]), (-20.0, 70.0)
    strip = interpolation_strip(method, tiny_set, samples, steps=2, azimuths=azimuths)
    left = strip.shape[1] - 5 * STEP - MARGIN
    assert strip.shape[0] == 3 * STEP + MARGIN
    way = method.decode(interpolation.walk(encode(method, tiny_set, samples), 2)).surfaces()
    pose = LookAtPoses(torch.zeros(1), 30.0, 2.732, 15.0)
    cameras = orbit(pose, azimuths)
    zoom = common_zoom([(surface, cameras) for surface in way], tiny_set.batch(samples).masks)
    ends = shapes(method, tiny_set, samples)
    for column, end in zip((0, 2, 4), ends, strict=True):
        views = draw_surface(end, orbit(pose, azimuths, zoom=zoom), image_size=TILE)
        for row in (0, 1):
            seen = cell(strip, 1 + row, column, top=0, left=left).astype(int)
            assert np.abs(seen - views[row]).mean() < 0.1
        assert (cell(strip, 0, column, top=0, left=left) < 250).any()
    assert (cell(strip, 0, 1, top=0, left=left) == 255).all()


def test_a_morph_is_an_endless_loop_through_the_images(tiny_set) -> None:
    samples, method = torch.tensor([3, 30, 60]), Ellipsoids()
    frames = morph(method, tiny_set, samples, steps=3, azimuths=(0.0, 90.0), image_size=40)
    assert frames.shape == (9, 2, 40, 40, 3)
    again = morph(method, tiny_set, samples[[1, 2, 0]], steps=3, azimuths=(0.0, 90.0), image_size=40)
    assert np.array_equal(np.roll(frames, -3, axis=0), again)
    assert not np.array_equal(frames[0], frames[3])
    with pytest.raises(ValueError, match="at least one azimuth"):
        morph(method, tiny_set, samples, azimuths=())


def test_images_of_an_interpolation_are_of_different_objects_seen_alike(tiny_set) -> None:
    samples = interpolation.typical_views(Ellipsoids(), tiny_set, 3, azimuth_deg=-40.0)
    assert sorted(tiny_set.object_ids[samples.numpy()].tolist()) == [0, 1, 2]
    assert azimuths_deg(tiny_set.poses[samples]).tolist() == pytest.approx([-45.0] * 3)
    with pytest.raises(ValueError, match="takes 2 to 3 images here"):
        interpolation.typical_views(Ellipsoids(), tiny_set, 4)


def test_typical_views_come_from_different_clusters(tiny_set) -> None:
    class Marked(Ellipsoids):
        def encode(self, images: Tensor) -> Tensor:
            return images[:, 0, 0, 0].float()[:, None]

    images = tiny_set.images.copy()[[0] * 9]
    images[:, 0, 0, 0] = [10, 11, 12, 13, 14, 99, 100, 101, 200]  # clusters around 12, 100 and 200
    many = dataclasses.replace(
        tiny_set.select(np.zeros(9, np.int64)),
        images=images,
        object_ids=np.arange(9),
        object_names=tuple("abcdefghi"),
        voxels=None,
    )
    assert interpolation.typical_views(Marked(), many, 3).tolist() == [2, 6, 8]


@pytest.mark.parametrize("method", [Ellipsoids(), GridEllipsoids()])
def test_profiles_are_means_of_the_evaluation_per_view(tiny_set, method) -> None:
    evaluation = evaluate(method, tiny_set)
    ious = evaluation.ious["kato18"].numpy()
    profile = polar.measure("run", method, tiny_set, batch_size=30)  # cuts no object in two
    assert profile.azimuths_deg.tolist() == [15.0 * k for k in range(24)]
    for k, azimuth in enumerate(profile.azimuths_deg):
        view = round(-azimuth / 15) % 24
        assert profile.iou[k] == pytest.approx(ious[evaluation.view_ids.numpy() == view].mean(), abs=1e-6)
    assert profile.mean_iou == pytest.approx(evaluation.voxel_iou, abs=1e-6)
    assert 0.3 < profile.consistency < 0.99


def test_consistency_is_the_mean_over_pairs_of_views(tiny_set) -> None:
    few = tiny_set.select(np.array([0, 1, 2, 30, 31, 60]))  # 3, 2 and 1 views of the objects
    method = Ellipsoids(depth_of_red=0.7)
    meshes = method.decode(method.encode(few.batch(torch.arange(6)).images))
    predicted = few.voxelize(meshes.vertices, meshes.faces)

    def iou(a: int, b: int) -> float:
        return float((predicted[a] & predicted[b]).sum() / (predicted[a] | predicted[b]).sum())

    profile = polar.measure("run", method, few)
    expected = ((iou(0, 1) + iou(0, 2) + iou(1, 2)) / 3 + iou(3, 4)) / 2
    assert profile.consistency == pytest.approx(expected, abs=1e-6)
    assert expected < 0.95
    at_zero = list(profile.azimuths_deg).index(0.0)
    assert profile.agreement[at_zero] == pytest.approx((iou(0, 1) + iou(0, 2)) / 2, abs=1e-6)
    assert np.isnan(profile.agreement).sum() == 1  # of the object that was seen once
    assert polar.measure("run", Ellipsoids(depth_of_red=0.0), few).consistency == 1.0


def test_profiles_need_the_truth(tiny_set) -> None:
    with pytest.raises(ValueError, match="airplane, test has no true voxels"):
        polar.measure("run", Ellipsoids(), dataclasses.replace(tiny_set, voxels=None))


def test_categories_stand_below_each_other(tiny_set, tmp_path) -> None:
    chairs = dataclasses.replace(tiny_set, category="chair")
    runs = [Run(label, Ellipsoids(), data) for data in (tiny_set, chairs) for label in ("a", "b")]
    one = Image.open(paper.save_grid(runs[:2], tmp_path / "one", images=2))
    two = Image.open(paper.save_grid(runs, tmp_path / "new" / "two.png"))
    assert two.height == 2 * one.height + 10
    assert two.width == one.width
    assert paper.save_grid(runs[:1], tmp_path / "three.png", indices=[5]).stat().st_size > 1000
    with pytest.raises(ValueError, match="indices must lie in"):
        paper.save_grid(runs[:1], tmp_path / "four.png", indices=[72])


def test_all_figures_say_what_could_not_be_drawn(tiny_set, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(paper, "FRAMES", 1)
    alone = dataclasses.replace(tiny_set.select(np.arange(8)), voxels=None)
    said: list[str] = []
    written = paper.save_all([Run("a", Ellipsoids(), alone)], [tmp_path], tmp_path / "out", say=said.append)
    assert sorted(path.name for path in written) == ["grid.png"]
    not_drawn = [text.split(":")[1].strip() for text in said if text.startswith("not drawn")]
    assert not_drawn == ["tsne", "interpolation", "curves", "polar"]
