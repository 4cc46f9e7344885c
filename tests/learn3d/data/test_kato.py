"""Kato's files: what is read back, which camera saw what, and what a bad file is told."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
import torch

import nmr
from learn3d.data.batch import Batch
from learn3d.data.categories import synset_of
from learn3d.data.conventions import KATO, mesh_to_object
from learn3d.data.readers import kato


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, 24, 4, 64, 64), dtype=np.uint8)
    return images, rng.random((2, 32, 32, 32)) < 0.3


def write(folder, images, voxels, prefix="03001627_test"):
    np.savez_compressed(folder / f"{prefix}_images.npz", images)
    np.savez_compressed(folder / f"{prefix}_voxels.npz", voxels)


def test_reads_back_what_was_written_by_name_and_by_synset(tmp_path, arrays):
    images, voxels = arrays
    write(tmp_path, images, voxels)
    for category in ("chair", "03001627"):
        dataset = kato.load(tmp_path, category, "test")
        assert (dataset.num_objects, dataset.num_views, len(dataset)) == (2, 24, 48)
        np.testing.assert_array_equal(dataset.images, images.reshape(48, 4, 64, 64))
        np.testing.assert_array_equal(dataset.voxels, voxels)


def test_batch_takes_object_times_24_plus_view(tmp_path, arrays):
    images, voxels = arrays
    write(tmp_path, images, voxels)
    batch = kato.load(tmp_path, "chair", "test").batch(torch.tensor([30, 0, 23]))
    assert isinstance(batch, Batch)
    assert batch.object_ids.tolist() == [1, 0, 0] and batch.view_ids.tolist() == [6, 0, 23]
    assert batch.images.dtype == torch.uint8 and batch.voxels.dtype == torch.bool
    np.testing.assert_array_equal(batch.images[0].numpy(), images[1, 6])
    np.testing.assert_array_equal(batch.voxels.numpy(), voxels[[1, 0, 0]])
    assert batch.masks.dtype == torch.float32 and float(batch.masks.max()) <= 1.0
    np.testing.assert_allclose(batch.masks.numpy(), batch.images[:, 3].numpy() / np.float32(255))


def test_view_k_is_seen_from_azimuth_minus_15_k_degrees(tmp_path, arrays):
    write(tmp_path, *arrays)
    cameras = kato.load(tmp_path, "chair", "test").batch(torch.tensor([0, 6, 12, 42])).cameras
    flat, height = 2.732 * np.cos(np.radians(30)), 2.732 * np.sin(np.radians(30))
    wanted = [[0, height, -flat], [-flat, height, 0], [0, height, flat], [flat, height, 0]]
    np.testing.assert_allclose(np.asarray(cameras.eye), wanted, atol=1e-5)
    # the half field of view is 15 degrees: a point that far off the axis lies on the right edge of the image
    edge = torch.tensor([[2.732 * np.tan(np.radians(15)), 0.0, 0.0]], dtype=torch.float32)
    assert float(cameras.transform(edge)[0, 0, 0]) == pytest.approx(1.0, abs=1e-5)


def test_voxel_axes_are_y_x_minus_z():
    vertices, faces = nmr.icosphere(1)
    centre = torch.tensor([0.3, 0.1, -0.2])
    occupied = KATO.voxelize(0.1 * vertices + centre, faces)[0].nonzero().float().mean(0)
    cell = (centre * 31 / 32 + 0.5) * 32 - 0.5  # cell index of the centre along x, y, z
    np.testing.assert_allclose(occupied.numpy(), [cell[1], cell[0], 31 - cell[2]], atol=0.6)


def test_mesh_to_object_puts_up_up_and_front_to_the_first_camera():
    axes = {s + a: (-1 if s else 1) * np.eye(3)[i] for i, a in enumerate("xyz") for s in ("", "-")}
    for up in axes:
        for front in axes:
            if up[-1] == front[-1]:
                with pytest.raises(ValueError, match="two different axes"):
                    mesh_to_object(up, front)
                continue
            matrix = mesh_to_object(up, front)
            np.testing.assert_array_equal(matrix @ axes[up], [0, 1, 0])
            np.testing.assert_array_equal(matrix @ axes[front], [0, 0, -1])
            assert np.linalg.det(matrix) == pytest.approx(-1)  # right-handed files, left-handed renderer
    np.testing.assert_array_equal(mesh_to_object() @ [1, 2, 3], [-3, 2, -1])
    with pytest.raises(ValueError, match="one of"):
        mesh_to_object("w")


def test_synset_of_known_and_other_names():
    assert synset_of("airplane") == "02691156" and synset_of("vessel") == "04530566"
    assert synset_of("teapot") == "teapot" and synset_of("03001627") == "03001627"
    for bad in ("a\nb", "\x1b[31m", "\udcff", "", "../chair", "a/b", ".hidden"):
        with pytest.raises(ValueError, match="plain name"):
            synset_of(bad)


def test_missing_files_are_named_with_what_is_there(tmp_path, arrays):
    with pytest.raises(FileNotFoundError, match="no such folder"):
        kato.load(tmp_path / "nowhere", "chair", "test")
    with pytest.raises(FileNotFoundError, match="holds no"):
        kato.load(tmp_path, "chair", "test")
    write(tmp_path, *arrays)
    with pytest.raises(FileNotFoundError, match=r"03001627_train_images.npz.*the folder holds: chair test"):
        kato.load(tmp_path, "chair", "train")
    (tmp_path / "03001627_test_voxels.npz").unlink()
    half = r"03001627_test_voxels.npz: .*: the images are there \(03001627_test_images.npz\), but .* needs the voxels"
    with pytest.raises(FileNotFoundError, match=half) as error:
        kato.load(tmp_path, "chair", "test")
    assert "the folder holds" not in str(error.value) and "make both again" in str(error.value)
    with pytest.raises(FileNotFoundError, match=r"holds no '\*_images.npz' with its '\*_voxels.npz'"):
        kato.load(tmp_path, "chair", "train")
    with pytest.raises(ValueError, match="train, val, test"):
        kato.load(tmp_path, "chair", "validation")


def test_wrong_shapes_dtypes_and_counts(tmp_path, arrays):
    images, voxels = arrays
    cases = [
        (images.astype(np.float32), voxels, r"images file .* uint8 \[N, 24, 4, 64, 64\].* got float32"),
        (images[:, :20], voxels, r"got uint8 \[2, 20, 4, 64, 64\]"),
        (images[0], voxels, r"got uint8 \[24, 4, 64, 64\]"),
        (images, voxels.astype(np.uint8), r"voxels file .* bool \[N, 32, 32, 32\].* got uint8"),
        (images, voxels[:, :16], r"got bool \[2, 16, 32, 32\]"),
        (images, voxels[:1], "holds 2 objects but .* holds 1"),
        (images[:0], voxels[:0], "holds no object"),
    ]
    for bad_images, bad_voxels, message in cases:
        write(tmp_path, bad_images, bad_voxels)
        with pytest.raises(ValueError, match=message):
            kato.load(tmp_path, "chair", "test")


def test_foreign_truncated_and_pickled_files(tmp_path, arrays):
    images, voxels = arrays
    write(tmp_path, images, voxels)
    path = tmp_path / "03001627_test_images.npz"
    whole = path.read_bytes()
    npy = io.BytesIO()
    np.save(npy, images)
    pickled = io.BytesIO()
    np.savez(pickled, np.array([{}, None], dtype=object))
    other_key = io.BytesIO()
    np.savez(other_key, images=images)
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 255
    empty_zip = io.BytesIO()
    zipfile.ZipFile(empty_zip, "w").close()
    cases = [
        (whole[: len(whole) // 2], "cannot be read"),
        (bytes(damaged), "cannot be read"),
        (b"<html>Not found</html>", "cannot be read"),
        (b"", "cannot be read"),
        (pickled.getvalue(), "no pickled objects"),
        (npy.getvalue(), "not an npz file"),
        (other_key.getvalue(), r"keys \['images'\]"),
        (empty_zip.getvalue(), r"keys \[\]|cannot read"),
    ]
    for content, message in cases:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            kato.load(tmp_path, "chair", "test")


def test_bad_indices(tmp_path, arrays):
    write(tmp_path, *arrays)
    dataset = kato.load(tmp_path, "chair", "test")
    for bad in ([48], [-1]):
        with pytest.raises(ValueError, match=r"0 \.\. 47"):
            dataset.batch(torch.tensor(bad))
    for bad in (torch.tensor([0.0]), torch.tensor([[0]]), torch.tensor([True])):
        with pytest.raises(TypeError, match="integer tensor"):
            dataset.batch(bad)
    assert len(dataset.batch(torch.tensor([], dtype=torch.int64)).images) == 0
