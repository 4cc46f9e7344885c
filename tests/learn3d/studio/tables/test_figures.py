"""The paper's figures, drawn with methods whose shapes are known beforehand; `learn3d figures` on a real short run."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_networks import FixedMethod
from torch import Tensor

import nmr
from learn3d.evaluation import picture_grid
from learn3d.methods.method import Grids, Meshes
from learn3d.pictures import HEADER, MARGIN, TILE, azimuths_deg, natural_colors
from learn3d.runs import checkpoint
from learn3d.studio.tables import grids
from learn3d.studio.tables.grids import comparison_grid, interpolate
from learn3d.studio.tables.trained_models import TrainedModel, name_runs, open_runs

pytest.importorskip("matplotlib")
pytest.importorskip("sklearn")

from learn3d.studio.tables import tsne

STEP = TILE + MARGIN
TURNS = (0, 60, 120, 180, 240, 300)
SPHERE, FACES = nmr.icosphere(2)


class Ellipsoids(FixedMethod):
    """As wide and as high as the mask; as deep as its centre is red, which differs from view to view."""

    def __init__(self, scale: float = 1.0, depth_of_red: float = 0.7) -> None:
        super().__init__()
        self.scale, self.depth_of_red = scale, depth_of_red

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


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch) -> None:
    monkeypatch.setattr(grids, "TILE_SIZE", TILE)


def cell(
    grid: np.ndarray, row: int, column: int, *, top: int = HEADER, columns: int = 7
) -> np.ndarray:
    y, x = top + MARGIN + row * STEP, grid.shape[1] - (columns - column) * STEP
    return grid[y : y + TILE, x : x + TILE]


def resized(picture: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(picture).resize((TILE,) * 2, Image.Resampling.BICUBIC))


@pytest.mark.parametrize("poses", ["known", "unknown"])
def test_picture_grid_shows_inputs_targets_and_renderings(tiny_set, poses) -> None:
    dataset = tiny_set if poses == "known" else dataclasses.replace(tiny_set, poses=None)
    samples, method = torch.tensor([3, 30]), Ellipsoids()
    grid, batch = picture_grid(method, dataset, samples), dataset.batch(samples)
    assert grid.shape == (HEADER + 2 * STEP + MARGIN, 9 * STEP + MARGIN, 3)
    for row in (0, 1):
        assert np.array_equal(
            cell(grid, row, 0, columns=9), resized(natural_colors(batch.images[row].numpy()))
        )
        mask = np.rint(255 * batch.masks[row].numpy()).astype(np.uint8)
        assert np.array_equal(cell(grid, row, 1, columns=9)[..., 0], resized(mask))
        rendered = cell(grid, row, 2, columns=9)[..., 0] > 127
        shaded = (cell(grid, row, 3, columns=9) < 250).any(axis=2)
        assert 0.01 < rendered.mean() < 0.5 and (shaded == rendered).mean() > 0.95
    nothing = picture_grid(Ellipsoids(scale=0.0), dataset, samples)
    assert (cell(nothing, 0, 2, columns=9) == 0).all() and np.array_equal(
        nothing[:, :STEP], grid[:, :STEP]
    )


def test_methods_are_drawn_below_each_other_from_the_same_views(tiny_set, monkeypatch) -> None:
    """Each row of a grid of two methods and the truth is that of a grid of one of them."""
    monkeypatch.setattr(grids, "common_zoom", lambda *_: 1.4)
    samples, methods = torch.tensor([3, 40]), {"large": Ellipsoids(), "small": GridEllipsoids(0.5)}
    runs = [TrainedModel(name, method, tiny_set) for name, method in methods.items()]
    both = comparison_grid(runs, samples, truth=True)
    assert both.shape[0] == HEADER + 6 * STEP + MARGIN
    alone = [comparison_grid([run], samples, truth=True) for run in runs]
    for i in (0, 1):
        assert not (cell(both, 3 * i, 0) == 255).all(), "the input"
        for column in range(7):
            rows = [cell(both, 3 * i + k, column) for k in range(3)]
            assert np.array_equal(rows[0], cell(alone[0], 2 * i, column)), "the truth"
            for k, grid in enumerate(alone, 1):
                assert np.array_equal(rows[k], cell(grid, 2 * i + 1, column))
        assert (cell(both, 3 * i + 1, 0) == 255).all(), "the input stands in the first row alone"
        large, small = (cell(both, 3 * i + k, 1).min(2) < 250 for k in (1, 2))
        assert large.sum() > 2 * small.sum() > 20


def test_the_truth_must_be_known(tiny_set) -> None:
    blind = dataclasses.replace(tiny_set, voxels=None)
    with pytest.raises(ValueError, match="airplane, test has no true voxels to show"):
        comparison_grid([TrainedModel("a", Ellipsoids(), blind)], torch.tensor([3]), truth=True)


@pytest.mark.parametrize("method", [Ellipsoids(), GridEllipsoids()])
def test_an_interpolation_goes_through_the_reconstructions_in_equal_steps(tiny_set, method) -> None:
    samples, decoded = torch.tensor([3, 30, 60]), []
    decode = method.decode
    method.decode = lambda codes: decoded.append(codes) or decode(codes)
    strip = interpolate(TrainedModel("a", method, tiny_set), samples)
    del method.decode
    codes = method.encode(tiny_set.batch(samples).images)
    way = torch.cat(decoded)
    torch.testing.assert_close(way[::4], codes)
    torch.testing.assert_close(way.diff(dim=0)[:4], (codes[1] - codes[0]).expand(4, -1) / 4)
    assert strip.shape[0] == 3 * STEP + MARGIN and len(way) == 9
    for column in range(9):
        tiles = [cell(strip, row, column, top=0, columns=9) < 250 for row in range(3)]
        assert tiles[0].any() == (column % 4 == 0), "the inputs"
        assert tiles[1].any() and tiles[2].any() and (tiles[1] != tiles[2]).any()
    with pytest.raises(ValueError, match="at least two images, got 1"):
        interpolate(TrainedModel("a", method, tiny_set), samples[:1])


VIEWS, OBJECTS = np.tile(np.arange(12), 20), np.repeat(np.arange(20), 12)


def entangled(share: float) -> np.ndarray:
    """Codes [240, 16] of 20 objects from 12 sides: `share` of the view, the rest of the object."""
    rng = np.random.default_rng(0)
    of_view, of_object = rng.normal(size=(12, 16))[VIEWS], rng.normal(size=(20, 16))[OBJECTS]
    return share * of_view + (1 - share) * of_object + 0.1 * rng.normal(size=(240, 16))


def test_the_view_is_told_from_entangled_codes_alone() -> None:
    accuracy, chance = tsne.view_accuracy(entangled(0.95), VIEWS, OBJECTS)
    assert accuracy > 0.95 and chance == pytest.approx(1 / 12, abs=0.03)
    accuracy, _ = tsne.view_accuracy(entangled(0.0), VIEWS, OBJECTS)
    # as often as by chance, not never: views of the same object do not count
    assert 0.02 < accuracy < 0.17
    assert tsne.view_accuracy(entangled(0.5)[:12], VIEWS[:12], OBJECTS[:12]) is None
    assert tsne.view_accuracy(entangled(0.5), 0 * VIEWS, OBJECTS) is None


def test_an_embedding_keeps_neighbours_and_is_always_the_same() -> None:
    codes = entangled(0.9)[:60]
    points = tsne.embed(codes)
    assert points.shape == (60, 2) and np.array_equal(points, tsne.embed(codes))
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    assert (VIEWS[:60][distances.argmin(axis=1)] == VIEWS[:60]).mean() > 0.9
    with pytest.raises(ValueError, match=r"at least 10 images, got \[9, 16\]"):
        tsne.embed(codes[:9])


def test_maps_are_coloured_by_the_azimuth_and_files_are_the_same_again(
    tiny_set, tmp_path, monkeypatch
) -> None:
    points = np.random.default_rng(0).normal(size=(72, 2)).astype(np.float32)
    monkeypatch.setattr(tsne, "embed", lambda codes: points)
    runs = [
        TrainedModel("$\\bad$", Ellipsoids(), tiny_set),
        TrainedModel("b", Ellipsoids(), tiny_set),
    ]
    wheel = tsne.cyclic_colors()
    scatter = tsne.draw_tsne(runs).axes[0].collections[0]
    azimuths = azimuths_deg(tiny_set.poses).numpy() % 360
    for position, color in zip(scatter.get_offsets(), scatter.get_facecolors(), strict=True):
        (index,) = np.flatnonzero((points == position).all(axis=1))
        assert np.allclose(color[:3], wheel[int(azimuths[index] / 360 * 256)], atol=1e-6)
    first, second = tsne.save_tsne(runs, tmp_path / "new" / "maps.svg")
    assert (first.name, second.name) == ("maps.png", "maps.svg")
    assert "view told from the code: " in second.read_text()
    tsne.save_tsne(runs, tmp_path / "again")
    assert (tmp_path / "again.svg").read_bytes() == second.read_bytes()


def test_categories_stand_below_each_other(tiny_set, tmp_path) -> None:
    chairs = dataclasses.replace(tiny_set, category="chair")
    runs = [
        TrainedModel(label, Ellipsoids(), data)
        for data in (tiny_set, chairs)
        for label in ("a", "b")
    ]
    (one,) = grids.save_grid(runs[:2], tmp_path / "one", images=1)
    (two,) = grids.save_grid(runs, tmp_path / "2", images=1)
    assert Image.open(two).height == 2 * Image.open(one).height + 10
    chosen = grids.choose_samples(tiny_set, 3).numpy()
    assert len(set(tiny_set.object_ids[chosen])) == len(set(tiny_set.view_ids[chosen])) == 3
    with pytest.raises(ValueError, match="indices must lie in"):
        grids.save_grid(runs[:1], tmp_path / "four.png", indices=[72])


@pytest.fixture
def call(command):
    return lambda *words: command("figures", *words)


def test_a_figure_from_a_run_to_a_file(call, finished_run, tmp_path) -> None:
    code, out, err = call(
        "tsne", "--runs", finished_run, "--output", tmp_path / "out" / "a", "--split", "train"
    )
    assert code == 0, err
    assert out.split() == [str(tmp_path / "out" / f"a.{kind}") for kind in ("png", "svg")]
    with Image.open(tmp_path / "out" / "a.png") as image:
        # something is drawn on white
        assert 0.005 < (np.asarray(image.convert("L")) < 200).mean() < 0.7


def test_the_images_of_an_interpolation_can_be_chosen(call, finished_run, tmp_path) -> None:
    options = ("--split", "train", "--indices", 1, 30)
    code, out, err = call(
        "interpolation", "--runs", finished_run, "--output", tmp_path / "i.gif", *options
    )
    assert (code, out.split()) == (0, [str(tmp_path / "i.png")]), err


def test_wrong_inputs_are_errors_in_one_line(call, finished_run, tmp_path) -> None:
    output = ("--output", tmp_path / "x")
    for arguments, message in (
        (("grid", "--runs"), "at least one run folder or checkpoint"),
        (("tsne", "--truth", "--runs", finished_run), "--truth does not go with the figure tsne"),
        (("grid", "--runs", tmp_path / "nowhere"), "nowhere"),
        (("grid", "--runs", finished_run, "--labels", "a", "b"), "there are 1 runs but 2 labels"),
        (("grid", "--runs", finished_run, "--images", 25), "has 24 images, 25 were asked for"),
        (
            ("tsne", "--runs", finished_run, "--category", "lamp"),
            "03636649_test_images.npz: is missing",
        ),
        (
            ("grid", "--runs", finished_run, "--output", f"{__file__}/grid.png"),
            "give another --output",
        ),
    ):
        code, out, err = call(arguments[0], *output, *arguments[1:])
        assert (code, out) == (1, ""), arguments
        assert err.splitlines()[-1].startswith("error: ") and message in err, (arguments, err)
    assert list(tmp_path.iterdir()) == []


def test_figures_need_poses(call, tiny_set, monkeypatch, tmp_path) -> None:
    without = TrainedModel("a", Ellipsoids(), dataclasses.replace(tiny_set, poses=None))
    opened = "learn3d.studio.tables.trained_models.open_runs"
    monkeypatch.setattr(opened, lambda *_, **__: [without])
    for figure in ("grid", "interpolation"):
        code, _, err = call(figure, "--runs", "x", "--output", tmp_path / "x")
        assert code == 1 and f"the figure {figure} needs camera poses" in err


def test_other_data_are_shown_without_the_poses_of_the_training(
    tiny_config, tiny_set, tmp_path, monkeypatch
) -> None:
    configs = {name: tiny_config(tmp_path, poses=tmp_path / name) for name in ("a", "b")}
    loaded = []
    monkeypatch.setattr(
        checkpoint, "load_method", lambda path, which: (Ellipsoids(), configs[path.name], None)
    )
    monkeypatch.setattr(
        checkpoint, "load_dataset", lambda *_, poses=None, **__: loaded.append(poses) or tiny_set
    )
    paths = [tmp_path / "a", tmp_path / "b"]
    for other in ({}, {"category": "airplane"}, {"data": tmp_path}):
        open_runs(paths, **other)
    assert loaded == [*paths, *paths, None]


def test_runs_are_called_by_what_tells_them_apart(tiny_config, tmp_path) -> None:
    proposed, vanilla = tiny_config(tmp_path), tiny_config(tmp_path, preset="peng2020-kato-vanilla")
    second, free = dataclasses.replace(proposed, seed=1), tiny_config(tmp_path, lambda_prior=0.0)
    paths = [tmp_path / "a", tmp_path / "b"]
    assert name_runs([vanilla, proposed], paths) == ["Vanilla-AE", "Proposed"]
    assert name_runs([proposed, second], paths) == ["a", "b"]
    chair = dataclasses.replace(proposed, category="chair")
    assert name_runs([proposed, chair], paths) == ["airplane: Proposed", "chair: Proposed"]
    assert name_runs([proposed, chair], paths, ["x", "y"]) == ["x", "y"]
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "best.safetensors").touch()
    assert name_runs([proposed, free], [tmp_path / "a" / "best.safetensors", tmp_path / "b"]) == [
        "a/best",
        "b",
    ]
