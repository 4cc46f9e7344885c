"""Kato's files: their content, their cameras, and the errors for damaged ones."""

from __future__ import annotations

import itertools
import shutil

import numpy as np
import pytest
import torch
from reader_checks import cut_short, problems

from learn3d.data.conventions import mesh_to_object, synset_of
from learn3d.data.readers import kato

IMAGES, VOXELS = "03001627_test_images.npz", "03001627_test_voxels.npz"


@pytest.fixture(scope="module")
def arrays():
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, 24, 4, 64, 64), dtype=np.uint8)
    return images, rng.random((2, 32, 32, 32)) < 0.3


@pytest.fixture(scope="module")
def original(arrays, tmp_path_factory):
    folder = tmp_path_factory.mktemp("kato")
    for name, array in zip((IMAGES, VOXELS), arrays, strict=True):
        np.savez(folder / name, array)
    return folder


@pytest.fixture
def folder(original, tmp_path):
    return shutil.copytree(original, tmp_path / "data")


def test_reads_back_what_was_written_by_name_and_by_synset(original, arrays) -> None:
    images, voxels = arrays
    for category in ("chair", "03001627"):
        dataset = kato.load(original, category, "test")
        assert (dataset.num_objects, dataset.num_views, len(dataset)) == (2, 24, 48)
        np.testing.assert_array_equal(dataset.images, images.reshape(48, 4, 64, 64))
        np.testing.assert_array_equal(dataset.voxels, voxels)
    batch = dataset.batch(torch.tensor([30, 0, 23]))
    assert batch.object_ids.tolist() == [1, 0, 0] and batch.view_ids.tolist() == [6, 0, 23]
    assert problems("kato", original, "test") == ()


def test_view_k_is_seen_from_azimuth_minus_15_k_degrees(original) -> None:
    cameras = kato.load(original, "chair", "test").batch(torch.tensor([0, 6, 12, 42])).cameras
    flat, height = 2.732 * np.cos(np.radians(30)), 2.732 * np.sin(np.radians(30))
    wanted = [[0, height, -flat], [-flat, height, 0], [0, height, flat], [flat, height, 0]]
    np.testing.assert_allclose(np.asarray(cameras.eye), wanted, atol=1e-5)
    # the half field of view is 15 degrees: a point that far off the axis lies on the right edge of the image
    edge = torch.tensor([[2.732 * np.tan(np.radians(15)), 0.0, 0.0]], dtype=torch.float32)
    assert float(cameras.transform(edge)[0, 0, 0]) == pytest.approx(1.0, abs=1e-5)


def test_mesh_to_object_puts_up_up_and_front_to_the_first_camera() -> None:
    axes = {s + a: (-1 if s else 1) * np.eye(3)[i] for i, a in enumerate("xyz") for s in ("", "-")}
    for up, front in itertools.product(axes, repeat=2):
        if up[-1] == front[-1]:
            with pytest.raises(ValueError, match="two different axes"):
                mesh_to_object(up, front)
        else:
            matrix = mesh_to_object(up, front)
            np.testing.assert_array_equal(matrix @ axes[up], [0, 1, 0])
            np.testing.assert_array_equal(matrix @ axes[front], [0, 0, -1])
            # right-handed files, left-handed renderer
            assert np.linalg.det(matrix) == pytest.approx(-1)
    np.testing.assert_array_equal(mesh_to_object() @ [1, 2, 3], [-3, 2, -1])
    with pytest.raises(ValueError, match="one of"):
        mesh_to_object("w")


def test_synset_of_known_and_other_names() -> None:
    for name, synset in {
        "airplane": "02691156",
        "aeroplane": "02691156",
        "vessel": "04530566",
        "teapot": "teapot",
        "03001627": "03001627",
    }.items():
        assert synset_of(name) == synset
    bad_names = ["a\nb", "a\0b", "\x1b[31m", "\udcff", "", "..", "../chair", "/tmp/chair", "a/b"]
    for bad in (*bad_names, "a\\b", ".hidden"):
        with pytest.raises(ValueError, match="plain name"):
            synset_of(bad)


def test_missing_files_are_named_with_those_that_are_there(folder) -> None:
    with pytest.raises(
        FileNotFoundError, match=r"03001627_train_images.npz.*The folder holds: chair test\."
    ):
        kato.load(folder, "chair", "train")
    (folder / VOXELS).unlink()
    with pytest.raises(FileNotFoundError, match=rf"{VOXELS}: is missing: a split is two files"):
        kato.load(folder, "chair", "test")
    with pytest.raises(FileNotFoundError, match="The folder holds no split"):
        kato.load(folder / "nowhere", "chair", "test")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            IMAGES,
            lambda images: images.astype(np.float32),
            r"images file .* uint8 \[N, 24, 4, 64, 64\].* got float32",
        ),
        (IMAGES, lambda images: images[0], r"got uint8 \[24, 4, 64, 64\]"),
        (
            VOXELS,
            lambda voxels: voxels.astype(np.uint8),
            r"voxels file .* bool \[N, 32, 32, 32\].* got uint8",
        ),
        (VOXELS, lambda voxels: voxels[:1], "holds 2 objects and .*_voxels.npz 1"),
        (IMAGES, lambda images: images[:0], "holds 0 objects"),
        (IMAGES, lambda images: np.array([{}, None], dtype=object), "no pickled objects"),
    ],
)
def test_wrong_shapes_dtypes_and_counts(folder, arrays, name, change, message) -> None:
    np.savez(folder / name, change(arrays[name == VOXELS]))
    if "holds 0" in message:
        np.savez(folder / VOXELS, arrays[1][:0])
    with pytest.raises(ValueError, match=message):
        kato.load(folder, "chair", "test")
    assert [p.severity for p in problems("kato", folder, "test")] == ["error"]


def test_warnings_and_errors_of_both_files_are_found(folder, arrays) -> None:
    images, voxels = (array.copy() for array in arrays)
    images[1, 5, 3], voxels[1] = 0, False
    np.savez(folder / IMAGES, images)
    np.savez(folder / VOXELS, voxels)
    found = [(p.severity, p.message) for p in problems("kato", folder, "test")]
    messages = ("the mask of object 1, view 5, is empty", "the grid of object 1 is empty")
    assert found == [("warning", message) for message in messages]
    cut_short(folder / IMAGES)
    np.savez(folder / VOXELS, np.zeros((2, 16, 16, 16), bool))
    assert [p.severity for p in problems("kato", folder, "test")] == ["error", "error"]
