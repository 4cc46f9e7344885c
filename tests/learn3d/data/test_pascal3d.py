"""Pascal3D+ files, written byte for byte as VPL packs them: what is read, where it lies, and what is refused."""

from __future__ import annotations

import dataclasses
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from python2_pickles import npy, python2_pickle
from reader_checks import problems
from scipy.spatial.transform import Rotation

import nmr
from learn3d.data import conventions
from learn3d.data.dataset import concatenate
from learn3d.data.layouts import check_folder
from learn3d.data.readers import pascal3d
from learn3d.data.sampling import augment
from learn3d.networks.resnet import ResNet18Encoder
from learn3d.runs.checkpoint import load_method
from learn3d.training import train


def rotation(*angles_deg: float) -> np.ndarray:
    return Rotation.from_euler("yzx", angles_deg, degrees=True).as_matrix()


def stretched(pixels: np.ndarray) -> np.ndarray:
    """A cut as the network sees it: uint8 [3, 224, 224]."""
    image = Image.fromarray(pixels).resize((224, 224), Image.Resampling.BILINEAR)
    return np.asarray(image).transpose(2, 0, 1)


def tetrahedra() -> tuple[torch.Tensor, torch.Tensor]:
    """A solid without any symmetry but z -> -z, within [-1, 1]: [V, 3], [F, 3]."""
    corners = torch.tensor(
        [[-0.9, -0.2, 0.0], [0.5, -0.5, 0.6], [0.5, -0.5, -0.6], [0.7, 0.1, 0.0], [0.1, 0.8, 0.0]]
    )
    faces = torch.tensor([[0, 1, 2], [0, 1, 4], [0, 2, 4], [1, 3, 4], [2, 3, 4], [1, 2, 3]])
    return corners, faces


def vpl_silhouette(
    vertices: torch.Tensor, faces: torch.Tensor, rotations: np.ndarray, size: int
) -> torch.Tensor:
    """The silhouettes of VPL's renderer, written out: u = R v, depth + 1 + 1e-5, an image that is in the end turned
    upside down (y up) and left-right (x to the left)."""
    u = vertices @ torch.from_numpy(rotations).float().transpose(1, 2)
    u = u + torch.tensor([0.0, 0.0, 1 + 1e-5])
    return nmr.render_silhouette(u, faces, None, image_size=size).flip(2)


ANGLES = [(0, 10, 0), (50, -20, 10), (-100, 5, -15), (170, 30, 40), (30, 20, -130)]


def arrays(seed: int, angles: list[tuple[float, float, float]]) -> dict[str, object]:
    rng = np.random.default_rng(seed)
    count = len(angles)
    rotations = np.stack([rotation(*a) for a in angles])
    references = np.full((count, 224, 224, 4), 77, np.uint8)
    references[..., 3] = 255 * vpl_silhouette(*tetrahedra(), rotations, 224).round().numpy()
    boxes = np.stack([[10.0, 20.0, 30.5, 25.0]] * count)
    boxes[0] = [-5, 0, 200, 300]  # Pascal's boxes may leave the image
    sizes = rng.integers(60, 120, (count, 2))
    return {
        "images": [rng.integers(0, 256, (*size, 3), np.uint8) for size in sizes],
        "images_ref": references,
        "bounding_boxes": boxes,
        "rotation_matrices": rotations.astype(np.float32),
        "voxels": rng.random((count, 32, 32, 32)) < 0.3,
    }


def write(path: Path, content: dict[str, np.ndarray | list[np.ndarray]]) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for key, value in content.items():
            if isinstance(value, list):
                archive.writestr(f"{key}.npy", npy(python2_pickle(value), len(value)))
            else:
                with archive.open(f"{key}.npy", "w") as file:
                    np.lib.format.write_array(file, value, version=(1, 0))


@pytest.fixture(scope="module")
def contents() -> dict[str, dict]:
    return {
        "train": arrays(1, ANGLES[:3]),
        "imagenet": arrays(2, ANGLES[1:4]),
        "val": arrays(3, [(1, 11, 1), (55, -20, 10), (30, 20, -130)]),
    }


@pytest.fixture
def folder(tmp_path: Path, contents: dict[str, dict]) -> Path:
    for name, content in contents.items():
        write(tmp_path / f"aeroplane_{name}.npz", content)
    return tmp_path


def test_training_is_train_and_imagenet(folder: Path, contents: dict[str, dict]) -> None:
    dataset = pascal3d.load(folder, "aeroplane", "train")
    assert len(dataset) == dataset.num_objects == 6 and dataset.image_size == 224
    assert dataset.object_names[2:4] == ("aeroplane_train/2", "aeroplane_imagenet/0")
    assert not dataset.inverted and dataset.convention is conventions.PASCAL3D
    np.testing.assert_array_equal(dataset.voxels[3:], contents["imagenet"]["voxels"])
    assert dataset.num_views == 4 and sorted(set(dataset.view_ids)) == [0, 1, 2, 3]
    # the same rotations
    np.testing.assert_array_equal(dataset.view_ids[[1, 2]], dataset.view_ids[[3, 4]])


def test_the_image_is_the_padded_clipped_stretched_box(
    folder: Path, contents: dict[str, dict]
) -> None:
    dataset = pascal3d.load(folder, "airplane", "train")
    whole, boxed, _ = contents["train"]["images"]
    np.testing.assert_array_equal(dataset.images[0, :3], stretched(whole))
    # box 10, 20, 30.5, 25: padded by 15 % to 5.425 .. 45.075 and 16.25 .. 48.75, cut to whole pixels
    np.testing.assert_array_equal(dataset.images[1, :3], stretched(boxed[16:48, 5:45]))
    reference = contents["train"]["images_ref"][..., 3]
    np.testing.assert_array_equal(dataset.images[:3, 3], reference)
    wanted = torch.nn.functional.interpolate(torch.from_numpy(reference)[:, None].float(), 64)[:, 0]
    np.testing.assert_array_equal(dataset.masks[:3], wanted.numpy())
    assert pascal3d.load(folder, "airplane", "train", image_size=64).images.shape == (6, 4, 64, 64)


def test_cameras_show_what_vpl_draws(folder: Path) -> None:
    """The stored masks were drawn by VPL's rule; a camera that is mirrored or upside down shows something else."""
    dataset = pascal3d.load(folder, "02691156", "train")
    batch = dataset.batch(torch.arange(6))
    vertices, faces = tetrahedra()
    drawn = nmr.render_silhouette(vertices, faces, batch.cameras, image_size=224)
    masks = torch.from_numpy(dataset.images[:, 3]).float() / 255
    assert nmr.losses.soft_iou_loss(drawn, masks) < 0.01
    assert nmr.losses.soft_iou_loss(drawn.flip(2), masks) > 0.1
    assert nmr.losses.soft_iou_loss(drawn.flip(1), masks) > 0.1


@pytest.mark.parametrize("z", [-0.9, -0.7, 0.0, 1.7])
def test_nothing_is_cut_off_that_vpl_draws(z: float) -> None:
    """VPL's near plane is at z' = -0.9; nearer triangles, up to the corner of the cube [-1, 1], are drawn, too."""
    triangle = torch.tensor([[-0.5, -0.5, z], [0.5, -0.5, z], [0.0, 0.5, z + 1e-4]])
    face, camera = torch.tensor([[0, 1, 2]]), pascal3d.poses(np.eye(3)[None]).cameras()
    drawn = nmr.render_silhouette(triangle, face, camera, image_size=32)
    vpl = vpl_silhouette(triangle, face, np.eye(3)[None], 32)
    assert (drawn >= vpl).all() and vpl.sum() > 100
    triangle[:, 2] = -(3**0.5)
    assert nmr.render_silhouette(triangle, face, camera, image_size=32).sum() > 100


def test_voxels_follow_vpls_rule() -> None:
    """(v + 1) / 2, last two axes exchanged, all three reversed."""
    vertices, faces = tetrahedra()
    grid = nmr.voxelize((vertices + 1) / 2, faces, size=32).transpose(2, 3).flip((1, 2, 3))
    assert torch.equal(conventions.PASCAL3D.voxelize(vertices, faces), grid)


def test_view_classes_of_val_are_those_of_training(folder: Path) -> None:
    train, val = (pascal3d.load(folder, "aeroplane", split) for split in ("train", "val"))
    assert train.view_names == val.view_names
    # The first two share the cells of training views. The third is in a cell of its own, 130 degrees
    # from ANGLES[3], the last of training, and farther from the others.
    assert val.view_ids.tolist() == train.view_ids[[0, 1, 5]].tolist()
    test = pascal3d.load(folder, "aeroplane", "test")
    np.testing.assert_array_equal(test.images, val.images)
    assert test.split == "test"


def test_rotation_cells_are_45_degrees_of_scipys_yzx_angles() -> None:
    cells = {
        (-135.1, 0, 0): (0, 4, 4),
        (-134.9, 0, 0): (1, 4, 4),
        (0, -46, 0): (4, 2, 4),
        (0, 0, 44.9): (4, 4, 4),
        (0, 0, 45.1): (4, 4, 5),
        (179, 0, 0): (7, 4, 4),
    }
    found = pascal3d.rotation_cells(np.stack([rotation(*angles) for angles in cells]))
    assert found.tolist() == [64 * y + 8 * z + x for y, z, x in cells.values()]
    noise = np.random.default_rng(0).normal(0, 1e-7, (50, 3, 3))
    assert len(set(pascal3d.rotation_cells(np.eye(3) + noise))) == 1
    ids, names = pascal3d.view_classes(np.eye(3)[None], np.stack([np.eye(3), rotation(100, 0, 0)]))
    assert ids.tolist() == [0]
    assert names == ("y 22.5°, z 22.5°, x 22.5°", "y 112.5°, z 22.5°, x 22.5°")


def test_crop_jitter_is_a_function_of_seed_and_step(
    folder: Path, contents: dict[str, dict]
) -> None:
    dataset = pascal3d.load(folder, "aeroplane", "train")
    batch = dataset.batch(torch.tensor([1, 4, 1, 0]))
    one, same, other, seed = (
        augment(batch, ["crop"], s, k, inverted=True).images
        for s, k in ((0, 7), (0, 7), (0, 8), (1, 7))
    )
    assert torch.equal(one, same)
    assert all((one != x).any() for x in (other, seed, batch.images))
    assert (one[0] != one[2]).any()  # the same photograph twice: cropped in two ways
    assert torch.equal(one[:, 3], batch.images[:, 3])  # the mask stays
    # It is the published rule on the original image, with the same random numbers.
    shifts = np.random.default_rng([0, 7, 1]).uniform(-1, 1, (4, 4))[0] * 0.15
    left, top, w, h = contents["train"]["bounding_boxes"][1]
    image = contents["train"]["images"][1]
    x0, y0 = max(0, int(left - (0.15 + shifts[0]) * w)), max(0, int(top - (0.15 + shifts[1]) * h))
    x1 = min(image.shape[1], int(left + w + (0.15 + shifts[2]) * w))
    y1 = min(image.shape[0], int(top + h + (0.15 + shifts[3]) * h))
    np.testing.assert_array_equal(one[0, :3].numpy(), stretched(image[y0:y1, x0:x1]))


def test_flip_image_leaves_mask_and_pose(folder: Path) -> None:
    batch = pascal3d.load(folder, "aeroplane", "train").batch(torch.arange(6))
    changed = augment(batch, ["crop", "flip-image"], 0, 1, inverted=True)
    cropped = augment(batch, ["crop"], 0, 1, inverted=True)
    colors = cropped.images[:, :3]
    same, flipped = (
        (changed.images[:, :3] == wanted).flatten(1).all(1) for wanted in (colors, colors.flip(3))
    )
    assert (flipped ^ same).all() and flipped.any() and same.any()
    assert torch.equal(changed.images[:, 3], batch.images[:, 3])
    assert torch.equal(changed.masks, batch.masks)
    assert changed.poses is batch.poses


def test_impossible_crops_are_refused(folder: Path) -> None:
    batch = pascal3d.load(folder, "aeroplane", "train").batch(torch.arange(2))
    with pytest.raises(ValueError, match=r"crop must be the first augmentation, .* got flip, crop"):
        augment(batch, ["flip", "crop"], 0, 1, inverted=True)
    with pytest.raises(ValueError, match="only the layout pascal3d without shards"):
        augment(dataclasses.replace(batch, crops=None), ["crop"], 0, 1, inverted=True)


def test_crops_follow_selection_and_joining(folder: Path) -> None:
    dataset = pascal3d.load(folder, "aeroplane", "train")
    some = dataset.select(np.array([4, 1]))
    np.testing.assert_array_equal(some.crops.cut(), dataset.images[[4, 1], :3])
    both = concatenate([dataset, dataset])
    np.testing.assert_array_equal(both.crops.cut(), np.concatenate([dataset.images[:, :3]] * 2))


DAMAGE = {
    r"images_ref must be \[224, 224, 4\] for each of 3 images": {
        "images_ref": np.zeros((3, 64, 64, 4), np.uint8)
    },
    "images_ref must be .*uint8 if images.*, got int8": {
        "images_ref": np.zeros((3, 224, 224, 4), np.int8)
    },
    r"voxels must be .* for each of 3 images .*, got bool \[2, 32, 32, 32\]": {
        "voxels": np.zeros((2, 32, 32, 32), bool)
    },
    "voxels.* must be numbers": {"voxels": [np.zeros(3, np.uint8)] * 3},
    r"images\[0\] must be uint8 \[H, W, 3\], got uint8": {
        "images": [np.zeros((9, 9, 1), np.uint8)] * 3
    },
    r"bounding_boxes\[0\] must be left, top, width, height": {
        "bounding_boxes": np.array([[0, 0, -1, 5]] * 3)
    },
    r"rotation_matrices\[0\] is no rotation: \[\[-1": {
        "rotation_matrices": -np.stack([np.eye(3)] * 3)
    },
    r"rotation_matrices\[0\] is no rotation: \[\[nan": {
        "rotation_matrices": np.full((3, 3, 3), np.nan)
    },
    "holds no images": None,
}


@pytest.mark.parametrize("message", DAMAGE)
def test_damaged_files_are_named(folder: Path, contents: dict[str, dict], message: str) -> None:
    change = DAMAGE[message] or {key: value[:0] for key, value in contents["val"].items()}
    write(folder / "aeroplane_val.npz", contents["val"] | change)
    with pytest.raises(ValueError, match=rf"aeroplane_val.npz.*{message}"):
        pascal3d.load(folder, "aeroplane", "val")
    assert problems("pascal3d", folder, "val", "aeroplane")[0].severity == "error"


def test_a_damaged_training_file_is_named_by_val_too(
    folder: Path, contents: dict[str, dict]
) -> None:
    write(folder / "aeroplane_imagenet.npz", {"rotation_matrices": np.zeros((3, 3, 3))})
    with pytest.raises(ValueError, match=r"imagenet.npz: rotation_matrices\[0\] is no rotation"):
        pascal3d.load(folder, "aeroplane", "val")
    (folder / "aeroplane_imagenet.npz").unlink()
    with pytest.raises(FileNotFoundError, match=r"imagenet.npz: is missing; expected an npz file"):
        pascal3d.load(folder, "aeroplane", "train")


@pytest.mark.parametrize(
    ("category", "split", "message"),
    [
        ("sofa", "train", "has the categories aeroplane, car, chair; got 'sofa'"),
        ("car", "imagenet", "split must be one of train, val, test; got 'imagenet'"),
    ],
)
def test_wrong_names_are_refused(tmp_path: Path, category, split, message) -> None:
    with pytest.raises(ValueError, match=message):
        pascal3d.load(tmp_path, category, split)


def test_everything_wrong_is_found_in_one_walk(folder: Path, contents: dict[str, dict]) -> None:
    found = check_folder("pascal3d", folder)
    assert [(s.split, s.objects, s.problems) for s in found] == [("train", 6, ()), ("val", 3, ())]
    references, voxels = (contents["val"][key].copy() for key in ("images_ref", "voxels"))
    references[1, ..., 3] = 0
    voxels[2] = False
    boxes = np.array([[0, 0, 0, 0], [10, 10, 5, 5], [900, 0, 5, 5]])
    change = {"images_ref": references, "voxels": voxels, "bounding_boxes": boxes}
    write(folder / "aeroplane_val.npz", contents["val"] | change)
    found = problems("pascal3d", folder, "val", "aeroplane")
    assert [f"{p.severity} {p.message.split(' ')[0]}" for p in found] == [
        "error bounding_boxes[0]",
        "error bounding_boxes[2]",
        "warning images_ref[1]",
        "warning voxels[2]",
    ]


def test_a_trained_model_does_without_the_pretrained_weights(
    folder: Path, tiny_config, tmp_path: Path
) -> None:
    weights = tmp_path / "resnet18.pth"
    torch.save(ResNet18Encoder().state_dict(), weights)
    config = tiny_config(
        tmp_path / "run",
        data=folder,
        category="aeroplane",
        preset="peng2020-pascal",
        pretrained=weights,
        generator="sphere-small",
        iterations=1,
        batch_size=2,
    )
    assert train(config).finished
    weights.unlink()
    assert train(dataclasses.replace(config, iterations=2), resume=True).progress.step == 2
    method, saved, _ = load_method(tmp_path / "run" / "last.safetensors")
    assert saved.settings == config.settings and method.image_size == 224
    shutil.rmtree(tmp_path / "run")
