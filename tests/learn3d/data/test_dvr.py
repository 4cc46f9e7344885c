"""NMR_Dataset, written to its description: the content of Kato's npz files comes out, and faults are named."""

from __future__ import annotations

import io
import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from reader_checks import cut_short, expect, silhouette_iou
from shapenet_files import CHAIR, COLOR, box_mesh, save, shapes, swap_frames, write_dvr

from learn3d.data import conventions
from learn3d.data.readers import dvr, kato

LISTS = {"train": ["b1"], "val": ["c2"], "test": ["a0"]}


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dvr")
    write_dvr(folder, LISTS)
    return folder


@pytest.fixture
def folder(original, tmp_path):
    return shutil.copytree(original, tmp_path / "dvr")


def mesh(number: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = box_mesh(shapes(3)[number])
    return swap_frames(vertices), faces


def test_images_and_cameras_are_those_of_katos_files(original):
    dataset = dvr.load(original, "chair", "train")
    assert (len(dataset), dataset.num_objects, dataset.num_views, dataset.image_size) == (24, 1, 24, 64)
    assert dataset.object_names == ("b1",) and dataset.voxels is None and dataset.inverted
    assert dataset.view_names == kato.VIEW_NAMES and dataset.view_ids.tolist() == list(range(24))
    inside = dataset.images[:, 3] == 255
    assert set(np.unique(dataset.images[:, 3])) == {0, 255}
    colors = dataset.images[:, :3].transpose(0, 2, 3, 1)
    np.testing.assert_array_equal(np.unique(colors[inside], axis=0), [[255 - c for c in COLOR]])
    assert not colors[~inside].any()
    torch.testing.assert_close(
        dataset.poses.features(), conventions.view_poses(torch.arange(24)).features(), rtol=0, atol=0
    )
    assert silhouette_iou(dataset, *mesh(1)).min() > 0.94


@pytest.mark.parametrize("determinant", [1, -1])
def test_any_world_of_cameras_and_points_is_brought_into_the_object_frame(tmp_path, determinant):
    world, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    write_dvr(tmp_path, {"test": ["a"]}, prefix="", world=world * np.sign(np.linalg.det(world)) * determinant)
    points = dvr.load(tmp_path, CHAIR, "test").points
    assert points.shape == (1, 500, 3) and points.dtype == np.float32
    low, high = swap_frames(shapes(1)[0]).min(1), swap_frames(shapes(1)[0]).max(1)
    outside = np.maximum(np.maximum(low[:, None] - points[0], points[0] - high[:, None]), 0)
    assert np.linalg.norm(outside, axis=2).min(0).max() < 2e-3  # float16
    assert not (np.abs(points[0, :, 0]) < 0.29).all()  # z of the mesh spans 0.6, its x spans 1


def test_points_are_as_many_as_asked_for_and_as_every_object_has(folder):
    assert dvr.load(folder, "chair", "test", points=100).points.shape == (1, 100, 3)
    assert dvr.load(folder, "chair", "test", points=0).points is None
    (folder / CHAIR / "softras_test.lst").write_text("a0\nb1\n")
    path = folder / CHAIR / "a0" / "pointcloud.npz"
    np.savez(path, points=np.zeros((7, 3)))
    assert dvr.load(folder, "chair", "test").points.shape == (2, 7, 3)


def test_grey_and_rgb_masks_and_transparent_images_are_read(folder):
    wanted = dvr.load(folder, "chair", "test").images
    root = folder / CHAIR / "a0"
    mask = np.asarray(Image.open(root / "mask" / "0000.png"))
    save(root / "mask" / "0000.png", np.dstack([mask] * 3))
    transparent = np.dstack([np.asarray(Image.open(root / "image" / "0000.png")) * (mask > 0)[..., None], mask])
    save(root / "image" / "0000.png", transparent)
    np.testing.assert_array_equal(dvr.load(folder, "chair", "test").images, wanted)


def test_contents_and_count(original):
    assert dvr.contents(original) == {CHAIR: ("train", "val", "test")}
    assert dvr.count(original, "chair", "val") == 1
    for split in LISTS:
        assert list(dvr.problems(original, "chair", split)) == []


def change_cameras(root, change):
    with np.load(root / "cameras.npz") as file:
        arrays = dict(file)
    change(arrays)
    np.savez(root / "cameras.npz", **arrays)


def set_matrix(k, change):
    def apply(arrays):
        arrays[f"world_mat_{k}"] = change(arrays[f"world_mat_{k}"].copy())

    return lambda root: change_cameras(root, apply)


def reverse_views(arrays):
    matrices = [arrays[f"world_mat_{k}"] for k in range(24)]
    for k in range(24):
        arrays[f"world_mat_{k}"] = matrices[-k]


def turned(axis: int, angle: float):
    def turn(matrix):
        c, s = np.cos(angle), np.sin(angle)
        a, b = [i for i in range(3) if i != axis]
        rotation = np.eye(4)
        rotation[[a, a, b, b], [a, b, a, b]] = [c, -s, s, c]
        if axis == 2:
            return rotation @ matrix
        eye = -matrix[:3, :3].T @ matrix[:3, 3]
        matrix = rotation @ matrix
        matrix[:3, 3] = -matrix[:3, :3] @ eye
        return matrix

    return turn


def npy_bytes() -> bytes:
    np.save(file := io.BytesIO(), np.zeros(3))
    return file.getvalue()


FAULTS = {
    "image/0003.png: is missing": lambda root: (root / "image" / "0003.png").unlink(),
    "mask/0023.png: is missing": lambda root: (root / "mask" / "0023.png").unlink(),
    "image/0000.png: cannot be decoded as an image": lambda root: cut_short(root / "image" / "0000.png"),
    "mask/0001.png: is 32x32 pixels": lambda root: save(root / "mask" / "0001.png", np.full((32, 32), 255, np.uint8)),
    "of the format I;16; expected 64x64 of 8 bits": lambda root: save(
        root / "mask" / "0001.png", np.full((64, 64), 999, np.uint16)
    ),
    "cameras.npz: is missing": lambda root: (root / "cameras.npz").unlink(),
    "cameras.npz: cannot be read": lambda root: cut_short(root / "cameras.npz"),
    "not an npz file": lambda root: (root / "pointcloud.npz").write_bytes(npy_bytes()),
    "lacks world_mat_7 (1 of 24 matrices)": lambda root: change_cameras(root, lambda a: a.pop("world_mat_7")),
    "world_mat_2 has the shape [3, 3]": set_matrix(2, lambda m: m[:3, :3]),
    "cameras.npz: has numbers that are not finite": set_matrix(2, lambda m: m * np.nan),
    "world_mat_4 is no rotation": set_matrix(4, lambda m: m * 1.1),
    "the camera of view 5 stands 0.": set_matrix(5, lambda m: m + 0.3 * np.eye(4, k=1) * (np.arange(4) == 3)),
    "the camera of view 6 does not look at the object": set_matrix(6, turned(1, 0.1)),
    "the camera of view 9 is rolled or mirrored": set_matrix(9, turned(2, 0.1)),
    "is rolled or mirrored": lambda root: change_cameras(root, reverse_views),
    "pointcloud.npz: cannot be read": lambda root: cut_short(root / "pointcloud.npz"),
    "pointcloud.npz: has no such array": lambda root: np.savez(root / "pointcloud.npz", normals=np.zeros((5, 3))),
    "pointcloud.npz: has the shape [5, 4]": lambda root: np.savez(root / "pointcloud.npz", points=np.zeros((5, 4))),
    "pointcloud.npz: has coordinates up to nan": lambda root: np.savez(
        root / "pointcloud.npz", points=np.full((5, 3), np.nan)
    ),
    "a0: is missing; expected the folder of an object": shutil.rmtree,
}


@pytest.mark.parametrize("message", FAULTS)
def test_faults_of_an_object_are_named_by_load_and_by_the_scan(folder, message):
    FAULTS[message](folder / CHAIR / "a0")
    expect(dvr, folder, "test", message)


def test_oddities_of_an_object_are_warnings(folder):
    save(folder / CHAIR / "a0" / "mask" / "0004.png", np.ones((64, 64), np.uint8))
    expect(dvr, folder, "test", "its mask is empty: the brightest of its values 0 .. 255 is 1", "warning")
    (folder / CHAIR / "b1" / "pointcloud.npz").unlink()
    expect(dvr, folder, "train", "pointcloud.npz: is missing", "warning")
    assert dvr.load(folder, "chair", "train").points is None


def test_faults_of_the_lists(folder):
    path = folder / CHAIR / "softras_test.lst"
    path.write_text("a0\na0\n")
    expect(dvr, folder, "test", "chair test lists a0 more than once", "warning")
    path.write_text("b1\n")
    expect(dvr, folder, "test", "chair test shares 1 objects with train, such as b1", "warning")
    path.write_text("../../etc\n")
    expect(dvr, folder, "test", "softras_test.lst: names the object '../../etc'; expected the plain name of a folder")
    path.write_text("\n")
    expect(dvr, folder, "test", "names no object; expected one id per line")
    path.unlink()
    expect(dvr, folder, "test", "is missing; expected a list of object ids, one per line. Splits here: train, val")
    shutil.rmtree(folder / CHAIR)
    expect(dvr, folder, "test", "there is no folder of 'chair'; those here are: none")
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        dvr.load(folder / "nowhere", "chair", "test")
    with pytest.raises(ValueError, match="split must be one of train, val, test; got 'all'"):
        dvr.load(folder, "chair", "all")


def test_everything_wrong_is_found_in_one_scan(folder):
    root = folder / CHAIR / "a0"
    cut_short(root / "image" / "0000.png")
    (root / "mask" / "0000.png").unlink()
    (root / "image" / "0020.png").write_bytes(b"")
    change_cameras(root, lambda arrays: arrays.pop("world_mat_0"))
    (folder / CHAIR / "softras_test.lst").write_text("gone\na0\n")
    found = [(p.path.removeprefix(str(folder / CHAIR)), p.severity) for p in dvr.problems(folder, "chair", "test")]
    assert sorted(path for path, severity in found if severity == "error") == [
        "/a0/cameras.npz",
        "/a0/image/0000.png",
        "/a0/image/0020.png",
        "/a0/mask/0000.png",
        "/gone",
    ]
