"""ShapeNet's renderings as DVR and Kar et al. packed them, written to their descriptions."""

from __future__ import annotations

import functools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import torch
from PIL import Image
from reader_checks import cut_short, expect, problems, silhouette_iou
from shapenet_files import CHAIR, COLOR, box_mesh, save, shapes, swap_frames, write_dvr, write_kar

from learn3d.data import shards
from learn3d.data.conventions import KAR, KATO, PASCAL3D, shards_folder, view_poses
from learn3d.data.layouts import load_dataset, reader
from learn3d.data.readers import dvr, kar
from learn3d.data.readers.kar import check_poses
from learn3d.files.images import read_with_depth
from learn3d.files.reading import DamagedFile
from nmr.metrics import voxel_iou

LISTS = {"train": ["b1"], "val": ["c2"], "test": ["a0"]}
ASIDE = np.eye(4)[[0]].T @ np.eye(4)[[3]]
OBJECT = "a0"  # of the split "test"


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    root = tmp_path_factory.mktemp("renderings")
    write_dvr(root / "dvr", LISTS)
    write_kar(root / "kar", LISTS, 80)  # the real renders have 224 pixels
    return root


@pytest.fixture
def copy(originals, tmp_path):
    return lambda layout: shutil.copytree(originals / layout, tmp_path / layout)


def views(folder: Path, name: str = OBJECT) -> Path:
    """The folder of the images of an object."""
    return folder / {"dvr": "", "kar": "renders"}[folder.name] / CHAIR / name


def grid(folder: Path) -> Path:
    """The voxels of an object."""
    return folder / "voxels" / "modelVoxels32" / CHAIR / f"{OBJECT}.mat"


def mesh(number: int) -> tuple[np.ndarray, np.ndarray]:
    """An object of `shapes` in the object frame."""
    vertices, faces = box_mesh(shapes(3)[number])
    return swap_frames(vertices), faces


def test_renders_voxels_and_cameras_of_kar_agree_with_the_object(originals) -> None:
    dataset = kar.load(originals / "kar", "chair", "test")
    assert (len(dataset), dataset.object_names) == (20, (OBJECT,))
    assert dataset.poses.half_fov_deg == pytest.approx(14.9314, abs=1e-4)
    assert silhouette_iou(dataset, *mesh(0)).min() > 0.92
    vertices, faces = map(torch.from_numpy, mesh(0))
    truth = torch.from_numpy(dataset.voxels)
    assert float(voxel_iou(KAR.voxelize(vertices, faces), truth)) > 0.75
    for other in (KATO, PASCAL3D):
        assert float(voxel_iou(other.voxelize(vertices, faces), truth)) < 0.4
    colors, mask = dataset.images[:, :3].transpose(0, 2, 3, 1), dataset.images[:, 3]
    assert (colors[mask == 255] == COLOR).all() and (colors[mask == 0] == 255).all()
    assert not dataset.inverted


def test_images_and_cameras_of_dvr_are_those_of_katos_files(originals) -> None:
    dataset = dvr.load(originals / "dvr", "chair", "train")
    assert (len(dataset), dataset.object_names) == (24, ("b1",))
    assert dataset.voxels is None and dataset.inverted
    inside = dataset.images[:, 3] == 255
    colors = dataset.images[:, :3].transpose(0, 2, 3, 1)
    np.testing.assert_array_equal(np.unique(colors[inside], axis=0), [[255 - c for c in COLOR]])
    assert not colors[~inside].any()
    assert torch.equal(dataset.poses.eyes(), view_poses(torch.arange(24)).eyes())
    assert silhouette_iou(dataset, *mesh(1)).min() > 0.94


@pytest.mark.parametrize("determinant", [1, -1])
def test_any_world_of_cameras_and_points_is_brought_into_the_object_frame(
    tmp_path, determinant
) -> None:
    world, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    write_dvr(
        tmp_path, {"test": ["a", "b"]}, world=world * np.sign(np.linalg.det(world)) * determinant
    )
    np.savez(tmp_path / CHAIR / "b" / "pointcloud.npz", points=np.zeros((400, 3)))
    points = dvr.load(tmp_path, CHAIR, "test").points
    assert points.shape == (2, 400, 3) and points.dtype == np.float32  # as many as every object has
    low, high = swap_frames(shapes(1)[0]).min(1), swap_frames(shapes(1)[0]).max(1)
    outside = np.maximum(np.maximum(low[:, None] - points[0], points[0] - high[:, None]), 0)
    assert np.linalg.norm(outside, axis=2).min(0).max() < 2e-3  # float16
    assert not (np.abs(points[0, :, 0]) < 0.29).all()  # z of the mesh spans 0.6, its x spans 1


def test_kar_has_the_protocol_of_the_published_code(copy) -> None:
    folder = copy("kar")
    train = load_dataset("kar", folder, "chair", "train")
    with pytest.raises(ValueError, match=r"views_per_object must lie in 1 \.\. 20, got 21"):
        load_dataset("kar", folder, "chair", "train", views_per_object=21)
    everything = kar.load(folder, "chair", "train", views_per_object=20)
    assert (len(train), len(kar.load(folder, "chair", "val"))) == (1, 20)  # render 0 alone, or all
    np.testing.assert_array_equal(train.images[0], everything.images[0])
    table = np.loadtxt(views(folder, "b1") / "view.txt")
    np.testing.assert_array_equal(
        everything.view_ids, (table[:, 0] + 180) // 15 * 3 + (table[:, 1] + 20) // 20
    )
    lists = json.loads((folder / "splits.json").read_text())
    lists[CHAIR]["test"] = [*sorted(kar.BROKEN), "a0"]
    (folder / "splits.json").write_text(json.dumps(lists))
    assert len(kar.BROKEN) == 3 and kar.load(folder, "chair", "test").object_names == ("a0",)


def test_kar_in_shards_with_all_views_has_the_same_protocol(copy) -> None:
    folder = copy("kar")
    load = functools.partial(load_dataset, "kar", folder, "chair", "train")
    alone, three = load(), load(views_per_object=3)
    shards.write_set(shards_folder(folder, "chair", "train"), "kar", load(views_per_object=20))
    for wanted, found in ((alone, load()), (three, load(views_per_object=3))):
        np.testing.assert_array_equal(found.images[np.arange(len(wanted))], wanted.images)


def test_objects_may_have_fewer_renders(copy) -> None:
    folder = copy("kar")
    for k in range(12, 20):
        (views(folder) / f"render_{k}.png").unlink()
    table = views(folder) / "view.txt"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:12]))
    assert len(kar.load(folder, "chair", "test")) == 12
    assert not problems("kar", folder, "test")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_mask_is_where_the_depth_is_below_250_in_8_bits(tmp_path, dtype) -> None:
    near, far = (249, 250) if dtype == np.uint8 else (249 * 256 + 255, 250 * 256)
    depth = np.full((64, 64), far, dtype)
    depth[10:20, 30:40] = near
    for name, array in (("color", np.zeros((64, 64, 3), np.uint8)), ("depth", depth)):
        Image.fromarray(array).save(tmp_path / f"{name}.png")
    image, mask, _ = read_with_depth(tmp_path / "color.png", tmp_path / "depth.png", 64)
    np.testing.assert_array_equal(mask, np.where(depth == near, 255, 0))
    np.testing.assert_array_equal(image[3], mask)


def test_large_images_keep_their_size_and_masks_have_64_pixels(originals) -> None:
    dataset = kar.load(originals / "kar", "chair", "test", image_size=80)
    assert dataset.image_size == 80 and set(np.unique(dataset.images[:, 3])) == {0, 255}
    small = kar.load(originals / "kar", "chair", "test").images[:, 3]
    np.testing.assert_array_equal(dataset.masks, small)
    assert len(np.unique(small)) > 2  # borders are averaged
    with pytest.raises(ValueError, match=r"expected a square image of at least 137x137"):
        kar.load(originals / "kar", "chair", "test", image_size=137)


def test_contents_and_splits(originals) -> None:
    for layout in ("dvr", "kar"):
        assert reader(layout).contents(originals / layout) == {CHAIR: tuple(LISTS)}
        assert [problems(layout, originals / layout, split) for split in LISTS] == [()] * len(LISTS)


def rewrite_row(k: int, text: str):
    def change(folder: Path) -> None:
        path = views(folder) / "view.txt"
        rows = path.read_text().splitlines()
        rows[k : k + 1] = [text] if text else []
        path.write_text("\n".join(rows))

    return change


def change_cameras(change):
    """Another dict of the camera file's arrays."""

    def apply(folder: Path) -> None:
        path = views(folder) / "cameras.npz"
        with np.load(path) as file:
            arrays = dict(file)
        np.savez(path, **change(arrays))

    return apply


def change_matrix(k: int, change):
    name = f"world_mat_{k}"
    return change_cameras(lambda arrays: arrays | {name: change(arrays[name].copy())})


def reverse_views(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {f"world_mat_{k}": arrays[f"world_mat_{-k % 24}"] for k in range(24)}


def turned(axis: int, angle: float):
    """A camera turned about one of its axes, at its place."""

    def turn(matrix: np.ndarray) -> np.ndarray:
        a, b = [i for i in range(3) if i != axis]
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.eye(3)
        rotation[[a, a, b, b], [a, b, a, b]] = [c, -s, s, c]
        matrix[:3] = rotation @ matrix[:3]
        return matrix

    return turn


def save_points(**arrays: np.ndarray):
    return lambda folder: np.savez(views(folder) / "pointcloud.npz", **arrays)


FAULTS = {
    ("dvr", "image/0003.png: is missing"): lambda f: (views(f) / "image" / "0003.png").unlink(),
    ("dvr", "mask/0023.png: is missing"): lambda f: (views(f) / "mask" / "0023.png").unlink(),
    ("dvr", "mask/0001.png: is 32x32 pixels"): lambda f: save(
        views(f) / "mask" / "0001.png", np.full((32, 32), 255, np.uint8)
    ),
    ("dvr", "cameras.npz: cannot be read"): lambda f: cut_short(views(f) / "cameras.npz"),
    ("dvr", "no item named 'world_mat_7.npy'"): change_cameras(
        lambda a: {key: a[key] for key in a if key != "world_mat_7"}
    ),
    ("dvr", "no rotation, or not finite"): change_matrix(2, lambda m: m * np.nan),
    ("dvr", "part of a matrix is no rotation"): change_matrix(4, lambda m: m * 1.1),
    ("dvr", "the camera of view 5 is not Kato's"): change_matrix(5, lambda m: m + 0.3 * ASIDE),
    ("dvr", "the camera of view 6 is not Kato's"): change_matrix(6, turned(1, 0.1)),
    ("dvr", "the camera of view 9 is not Kato's"): change_matrix(9, turned(2, 0.1)),
    ("dvr", "neither rolled nor mirrored"): change_cameras(reverse_views),
    ("dvr", "pointcloud.npz: is missing"): lambda f: (views(f) / "pointcloud.npz").unlink(),
    ("dvr", "pointcloud.npz: has the shape [5, 4]"): save_points(points=np.zeros((5, 4))),
    ("dvr", "pointcloud.npz: has coordinates up to nan"): save_points(
        points=np.full((5, 3), np.nan)
    ),
    ("kar", "render_19.png: is missing"): lambda f: (views(f) / "render_19.png").unlink(),
    ("kar", "depth_5.png: cannot be read ("): lambda f: cut_short(views(f) / "depth_5.png"),
    ("kar", "view.txt: is missing"): lambda f: (views(f) / "view.txt").unlink(),
    ("kar", "view.txt: cannot be read (19 rows of finite numbers, 20 are needed)"): rewrite_row(
        4, "1 nan 0 2"
    ),
    ("kar", "view.txt: row 4 has azimuth 1, elevation 95 and distance 2"): rewrite_row(
        4, "1 95 0 2"
    ),
    ("kar", "a0.mat: is missing"): lambda f: grid(f).unlink(),
    ("kar", "a0.mat: has float64 [16, 16, 16]"): lambda f: scipy.io.savemat(
        grid(f), {"Volume": np.ones((16,) * 3)}
    ),
}


@pytest.mark.parametrize(("layout", "message"), FAULTS)
def test_faults_of_an_object_are_named_by_load_and_by_the_check(copy, layout, message) -> None:
    FAULTS[layout, message](folder := copy(layout))
    expect(layout, folder, "test", message)


@pytest.mark.parametrize("pose", [(1e30, 5, 2), (1, 5, 0), (1, np.nan, 2)])
def test_impossible_poses_are_refused(pose) -> None:
    with pytest.raises(DamagedFile, match=r"row 1 has azimuth .*; expected a table"):
        check_poses(Path("view.txt"), np.array([(0.0, 0.0, 2.0), pose]), "a table")


def test_oddities_of_an_object_are_warnings(copy) -> None:
    folder = copy("dvr")
    save(views(folder) / "mask" / "0004.png", np.ones((64, 64), np.uint8))
    message = "its mask is empty: the brightest of its values 0 .. 255 is 1"
    expect("dvr", folder, "test", message, "warning")
    folder = copy("kar")
    scipy.io.savemat(grid(folder), {"Volume": np.zeros((32, 32, 32), np.uint8)})
    expect("kar", folder, "test", "a0.mat: the grid is empty", "warning")


LIST_FAULTS = {
    "splits.json: cannot be read (JSON": "{",
    "splits.json: cannot be read (ids must be lists of text)": '{"03001627": {"test": "a0"}}',
    "cannot be read (AttributeError: 'list' object has no attribute 'values'); expected": '["03001627"]',
    "has no entry 03001627 (chair); it has: 02691156": '{"02691156": {"test": ["a0"]}}',
    "names the object '../../../etc'; expected the plain name": '{"03001627": {"test": ["../../../etc"]}}',
    "names the object '..'; expected the plain name": '{"03001627": {"test": [".."]}}',
    "names the object '/etc'; expected the plain name": '{"03001627": {"test": ["/etc"]}}',
    "names no object for test": '{"03001627": {"test": []}}',
}


@pytest.mark.parametrize("message", LIST_FAULTS)
def test_faults_of_the_lists_of_kar(copy, message) -> None:
    (folder := copy("kar")).joinpath("splits.json").write_text(LIST_FAULTS[message])
    expect("kar", folder, "test", message)


def test_lists_that_are_absent_or_overlap(copy) -> None:
    folder = copy("dvr")
    path = folder / CHAIR / "softras_test.lst"
    path.write_text("a0\na0\n")
    expect("dvr", folder, "test", "test lists a0 more than once", "warning")
    path.write_text("b1\n")
    expect("dvr", folder, "test", "test shares 1 objects with train, such as b1", "warning")
    path.unlink()
    expect("dvr", folder, "test", "is missing; expected a list of ids. Splits here: train, val")
    (folder / CHAIR).rename(folder / "02691156")
    expect("dvr", folder, "train", "there is no folder of 'chair'; those here are: 02691156")


def test_everything_wrong_is_found_in_one_walk(copy) -> None:
    folder = copy("kar")
    root = views(folder)
    cut_short(root / "render_3.png")
    (root / "render_4.png").unlink()
    (root / "view.txt").write_text("nan nan nan nan\n" * 20)
    lists = {"name": "chair", **LISTS, "test": ["a0", "gone"], "val": ["c2", "b1"]}
    (folder / "splits.json").write_text(json.dumps({CHAIR: lists}))
    found = problems("kar", folder, "test")
    names = ["view.txt", "render_3.png", "render_4.png", "gone"]
    assert [Path(p.path).name for p in found] == names
    (shared,) = problems("kar", folder, "train")
    assert shared.message == "train shares 1 objects with val, such as b1"
