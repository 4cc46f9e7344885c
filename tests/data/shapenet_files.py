"""Data sets in the layouts of ShapeNet's renderings, written from the descriptions of their formats alone.

One made object, a few boxes without any symmetry, in the frame of a mesh file (right-handed, y up), drawn by casting a
ray through every pixel's centre: nothing here knows nmr or learn3d.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import scipy.io
from PIL import Image

CHAIR = "03001627"
BOXES = np.array(
    [
        [[-0.5, -0.2, -0.3], [0.5, 0.0, 0.1]],  # seat
        [[-0.5, 0.0, -0.3], [-0.3, 0.4, 0.1]],  # back, at -x
        [[0.1, 0.0, 0.0], [0.3, 0.15, 0.3]],  # something on top, towards +z
        [[0.3, -0.4, -0.3], [0.5, -0.2, -0.15]],  # a single leg
    ]
)
COLOR = (200, 60, 20)
UP = np.array([0.0, 1.0, 0.0])


def box_mesh(boxes: np.ndarray = BOXES) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [8 n, 3] and faces [12 n, 3] of the boxes."""
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    sides = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    faces = np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])
    vertices = [np.where(corners, high, low) for low, high in boxes]
    return np.concatenate(vertices), np.concatenate([faces + 8 * i for i in range(len(boxes))])


def inside(points: np.ndarray, boxes: np.ndarray = BOXES) -> np.ndarray:
    """Which points [..., 3] of the mesh's frame lie in a box."""
    return np.any([((points >= low) & (points <= high)).all(-1) for low, high in boxes], axis=0)


def cell_centres(size: int = 32) -> np.ndarray:
    """Centres [s, s, s, 3] of the cells of a grid that spans [-0.5, 0.5]^3."""
    centre = (np.arange(size) + 0.5) / size - 0.5
    return np.stack(np.meshgrid(centre, centre, centre, indexing="ij"), axis=-1)


def draw(eye, right, tangent: float, size: int, boxes: np.ndarray = BOXES) -> np.ndarray:
    """Which pixels [size, size] of a camera at `eye` (mesh's frame), looking at the origin, show a box."""
    forward = -np.asarray(eye) / np.linalg.norm(eye)
    up = np.cross(right, forward)
    up *= np.sign(up @ UP)
    x = (np.arange(size) + 0.5) / size * 2 - 1
    rays = forward + tangent * (x[None, :, None] * right - x[:, None, None] * up)
    shown = np.zeros((size, size), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        for low, high in boxes:
            near, far = np.sort([(low - eye) / rays, (high - eye) / rays], axis=0)
            shown |= near.max(-1) < far.min(-1)
    return shown


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def blender_eye(azimuth_deg: float, elevation_deg: float, distance: float) -> np.ndarray:
    """Where Kato's Blender script puts the camera, in the mesh's frame: (x, z, -y) of Blender."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    x, y, z = np.cos(-a) * np.cos(e), np.sin(-a) * np.cos(e), np.sin(e)
    return distance * np.array([x, z, -y])


def nmr_eye(azimuth_deg: float, elevation_deg: float, distance: float) -> np.ndarray:
    """NMR's get_points_from_angles, in NMR's left-handed frame."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    return distance * np.array([np.cos(e) * np.sin(a), np.sin(e), -np.cos(e) * np.cos(a)])


def swap_frames(v: np.ndarray) -> np.ndarray:
    """The mesh's frame to NMR's, and back: (-z, y, -x)."""
    return np.stack([-v[..., 2], v[..., 1], -v[..., 0]], axis=-1)


def rgb(shown: np.ndarray, background: int = 255) -> np.ndarray:
    return np.where(shown[..., None], COLOR, background).astype(np.uint8)


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def shapes(count: int) -> list[np.ndarray]:
    """Boxes of `count` objects that differ in height."""
    return [BOXES * [1.0, 1.0 - 0.2 * i, 1.0] for i in range(count)]


def write_dvr(folder: Path, lists: dict[str, list[str]], world: np.ndarray | None = None):
    """NMR_Dataset; `world` turns the world of cameras and points away from the mesh's frame."""
    world = np.eye(3) if world is None else world
    names = sorted(name for ids in lists.values() for name in ids)
    rng = np.random.default_rng(0)
    for name, boxes in zip(names, shapes(len(names)), strict=True):
        root = folder / CHAIR / name
        cameras = {}
        for k in range(24):
            eye = blender_eye(15 * k, 30, 2.732)
            right = unit(np.cross(-eye, UP))
            shown = draw(eye, right, np.tan(np.radians(15)), 64, boxes)
            save(root / "image" / f"{k:04d}.png", rgb(shown))
            save(root / "mask" / f"{k:04d}.png", np.where(shown, 255, 0).astype(np.uint8))
            # x right, y down, z away
            rotation = np.stack([right, np.cross(unit(-eye), right), unit(-eye)])
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = rotation @ world.T, -rotation @ eye
            cameras[f"world_mat_{k}"], cameras[f"world_mat_inv_{k}"] = matrix, np.linalg.inv(matrix)
            cameras[f"camera_mat_{k}"] = np.diag([2 * 1.8660254, 2 * 1.8660254, 1, 1])
        np.savez(root / "cameras.npz", **cameras)
        vertices, faces = box_mesh(boxes)
        corner = vertices[faces[rng.integers(0, len(faces), 500)]]
        points = (corner * rng.dirichlet([1, 1, 1], 500)[..., None]).sum(1) @ world.T
        np.savez(
            root / "pointcloud.npz", points=points.astype(np.float16), normals=np.zeros_like(points)
        )
    for split, ids in lists.items():
        (folder / CHAIR / f"softras_{split}.lst").write_text("\n".join(ids) + "\n")


def write_kar(folder: Path, lists: dict[str, list[str]], size: int = 224):
    """shapenet_release of LSM, with splits.json laid beside it."""
    rng = np.random.default_rng(0)
    names = sorted({name for ids in lists.values() for name in ids})
    for name, boxes in zip(names, shapes(len(names)), strict=True):
        root = folder / "renders" / CHAIR / name
        rows = []
        for k in range(20):
            azimuth = rng.uniform(-180, 180)
            elevation = rng.uniform(-20, 40)
            distance = rng.uniform(1.9, 2.3)
            eye = nmr_eye(azimuth, elevation, distance)
            right = unit(np.cross(UP, -eye))  # a left-handed frame
            shown = draw(swap_frames(eye), swap_frames(right), 16 / 60, size, boxes)
            save(root / f"render_{k}.png", rgb(shown))
            depth = np.where(shown, 90, 255).astype(np.uint8)
            save(root / f"depth_{k}.png", depth)
            rows.append(f"{azimuth:.6f} {elevation:.6f} 0.000000 {distance:.6f}")
        (root / "view.txt").write_text("\n".join(rows) + "\n")
        # Index (i, j, k) is the cell at (-z, y, x) of NMR's frame.
        centre = cell_centres()
        volume = inside(
            swap_frames(np.stack([centre[..., 2], centre[..., 1], -centre[..., 0]], axis=-1)), boxes
        )
        path = folder / "voxels" / "modelVoxels32" / CHAIR / f"{name}.mat"
        path.parent.mkdir(parents=True, exist_ok=True)
        scipy.io.savemat(path, {"Volume": volume.astype(np.uint8)})
    (folder / "splits.json").write_text(json.dumps({CHAIR: {"name": "chair"} | lists}))
