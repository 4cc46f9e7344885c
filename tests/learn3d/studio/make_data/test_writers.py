"""Layouts against their descriptions: masks are those of the TRUE mesh under the numbers in the files.

Nothing here goes through our readers: `data/test_round_trip.py` compares what these read with the
meshes. If the description is in right-handed world coordinates, so is the test: cameras are
OpenCV's.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from lopsided_meshes import make, write_meshes
from PIL import Image
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.data.poses import Poses
from learn3d.studio.make_data.writers import WRITERS
from learn3d.studio.make_data.writers.photographs import over
from learn3d.studio.make_data.writers.writer import RenderedObject

SYNSET = "03001627"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_meshes(tmp_path_factory.mktemp("meshes"))


def true_mesh(folder: Path, name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices float64 [V, 3] in the mesh's right-handed frame (x front, y up), box centred, longest side 1; faces."""
    (path,) = (p for p in folder.iterdir() if p.stem.replace(" ", "_") in name)
    mesh = trimesh.load(path, force="mesh", process=False)
    vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / mesh.extents.max()
    return torch.from_numpy(np.asarray(vertices)), torch.from_numpy(np.asarray(mesh.faces))


def in_object_frame(vertices: torch.Tensor) -> torch.Tensor:
    return (vertices @ torch.from_numpy(mesh_to_object("y", "x").T)).float()


def silhouette(vertices, faces, camera, size) -> np.ndarray:
    alpha = nmr.render_silhouette(vertices.float(), faces, camera, image_size=size)
    return np.rint(255 * alpha[0].numpy())


def assert_same_mask(stored: np.ndarray, wanted: np.ndarray) -> None:
    """Equal but for a few subpixels on the edge, which the rounding of another camera model moves."""
    assert (stored > 0).any() and (stored == 0).any()
    assert (stored != wanted).mean() < 5e-4 and np.abs(stored - wanted).max() <= 64, (
        stored != wanted
    ).mean()


def opencv_camera(eye: np.ndarray, focal: float, size: int) -> nmr.cameras.Camera:
    """The camera at `eye`, in right-handed coordinates with y up, that looks at the origin; focal length in pixels."""
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pixels = [[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]
    return nmr.cameras.from_opencv(
        pixels, rotation, -rotation @ eye, height=size, width=size, pixel_center=0.5
    )


def read_image(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path)).astype(float)


def views(layout: str, radius: float, count: int, seed: int) -> Poses:
    """The cameras of a layout around an object of that radius."""
    return WRITERS[layout].views(np.array([[radius, 0.0, 0.0]]), count, np.random.default_rng(seed))


def test_files_of_kar_that_the_reader_leaves(tmp_path, folder):
    """Lists, metres of depth and matrices of cameras; `data/test_round_trip.py` has images, view.txt and voxels."""
    make(tmp_path, folder, "kar", test=1, val=1, views=3)
    splits = json.loads((tmp_path / "splits.json").read_text())[SYNSET]
    assert splits["name"] == "chair"
    assert [len(splits[split]) for split in ("train", "val", "test")] == [3, 1, 1]
    (name,) = splits["test"]
    mesh, faces = true_mesh(folder, name)
    vertices, root = in_object_frame(mesh), tmp_path / "renders" / SYNSET / name
    for i, (azimuth, elevation, _, distance) in enumerate(np.loadtxt(root / "view.txt")):
        alpha = read_image(root / f"render_{i}.png")[..., 3]
        camera = nmr.LookAt.from_angles([distance], [elevation], [azimuth], half_fov_deg=14.9314)
        true_depth = nmr.render_depth(vertices, faces, camera, image_size=224, anti_aliasing=False)[
            0
        ].numpy()
        depth = read_image(root / f"depth_{i}.png")
        metres, seen = depth / 240 * 1.8 + distance - 0.9, (depth < 250) & (alpha == 255)
        assert seen.mean() > 0.05
        np.testing.assert_allclose(metres[seen], true_depth[seen], atol=0.005)
        matrices = loadmat(root / f"camera_{i}.mat")
        rotation, offset = matrices["extrinsic"][:, :3], matrices["extrinsic"][:, 3]
        opencv = nmr.cameras.from_opencv(
            matrices["K"], rotation, offset, height=224, width=224, pixel_center=0.5
        )
        assert_same_mask(alpha, silhouette(mesh, faces, opencv, 224))
        quaternion = Rotation.from_quat(np.roll(matrices["quat"].reshape(4), -1))
        np.testing.assert_allclose(quaternion.as_matrix(), rotation, atol=1e-6)


def test_colours_are_unmixed_from_white_and_mixed_with_backgrounds():
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (2, 8, 8, 3))
    alpha = rng.choice([0, 64, 128, 191, 255], (2, 8, 8)).astype(np.uint8)
    share = alpha[..., None] / 255
    rgb = np.rint(color * share + 255 * (1 - share)).astype(np.uint8)
    item = RenderedObject("a", "train", None, None, None, rgb, alpha, None, rng)
    rgba = item.rgba()
    assert (
        rgba.dtype == np.uint8 and (rgba[..., 3] == alpha).all() and (rgba[alpha == 0] == 0).all()
    )
    assert np.abs(rgba[..., :3].astype(int) - color)[alpha >= 128].max() <= 2
    background = rng.integers(0, 256, rgb.shape).astype(np.uint8)
    wanted = color * share + background * (1 - share)
    assert np.abs(over(item, background) - wanted).max() <= 1.01
    np.testing.assert_array_equal(over(item, np.full_like(rgb, 255)), rgb)


def test_photos(tmp_path, folder):
    make(tmp_path, folder, "photos", views=2, test=1)
    with open(tmp_path / "chair" / "poses.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10 and [row["split"] for row in rows].count("test") == 2
    assert len({row["fov_deg"] for row in rows}) == 10  # each by another lens
    for row in rows[:3]:
        vertices, faces = true_mesh(folder, row["object"])
        azimuth, elevation, distance, fov = map(float, list(row.values())[1:5])
        # anti-clockwise from the front, seen from above: x is front, -z right
        a, e = np.deg2rad([azimuth, elevation])
        eye = distance * np.array([np.cos(e) * np.cos(a), np.sin(e), -np.cos(e) * np.sin(a)])
        mask = read_image(tmp_path / "chair" / "masks" / row["file"])
        camera = opencv_camera(eye, 128 / np.tan(np.deg2rad(fov / 2)), 256)
        assert_same_mask(mask, silhouette(vertices, faces, camera, 256))
        assert read_image(tmp_path / "chair" / "images" / row["file"])[mask == 0].std() > 5


def test_ranges_and_decimals():
    kar, photos = (views(layout, 0.7, 4000, 0) for layout in ("kar", "photos"))
    for poses, azimuths, elevations in (
        (kar, (-180, 180), (-20, 40)),
        (photos, (-180, 180), (-10, 50)),
    ):
        for values, (low, high) in (
            (poses.azimuth_deg, azimuths),
            (poses.elevation_deg, elevations),
        ):
            assert low <= values.min() and values.max() <= high
            spread = torch.histc(values, 8, low, high) / len(values)  # uniform
            assert (spread - 1 / 8).abs().max() < 0.03
            rounded = np.float32([float(f"{value:.4f}") for value in values.tolist()])
            np.testing.assert_array_equal(rounded, values.numpy())
    assert 12 <= photos.half_fov_deg.min() and photos.half_fov_deg.max() <= 25


def test_pascal3d_rotations_are_upright_but_for_the_tilt():
    in_object_frame = views("pascal3d", 0.8, 500, 2).rotation.double().numpy()
    rotations = in_object_frame @ WRITERS["pascal3d"].turn
    up = rotations[:, :, 1]  # the object's y in the picture: right, up, away
    tilt = np.rad2deg(np.arctan2(up[:, 0], up[:, 1]))
    assert np.abs(tilt).max() <= 15 and np.ptp(tilt) > 25
    elevation = np.rad2deg(np.arcsin(-up[:, 2]))  # seen from above, up comes towards the camera
    assert -10 <= elevation.min() < -5 and 35 < elevation.max() <= 40
