"""3D-R2N2's renderings, written to their description: renders and voxels agree, and faults are named."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from PIL import Image
from reader_checks import cut_short, expect, silhouette_iou
from shapenet_files import CHAIR, COLOR, binvox_bytes, box_mesh, save, shapes, swap_frames, write_r2n2

from learn3d.data.conventions import KATO
from learn3d.data.readers import r2n2
from learn3d.data.readers.kar import KAR
from learn3d.data.readers.r2n2 import R2N2
from learn3d.data.view_bins import AngleBins
from nmr.metrics import voxel_iou

SIZE = 72  # the real renders have 137 pixels


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("r2n2")
    write_r2n2(folder, ["a0", "b1"], SIZE)
    return folder


@pytest.fixture
def folder(original, tmp_path):
    return shutil.copytree(original, tmp_path / "r2n2")


def renders(folder, name="b1"):
    return folder / "ShapeNetRendering" / CHAIR / name / "rendering"


def grid(folder, name="b1"):
    return folder / "ShapeNetVox32" / CHAIR / name / "model.binvox"


def mesh(number: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = box_mesh(shapes(2)[number])
    return swap_frames(vertices), faces


@pytest.mark.parametrize("scale", [1.0, 0.8])
def test_renders_voxels_and_cameras_agree_with_the_object_that_they_were_made_from(original, tmp_path, scale):
    if scale != 1:
        write_r2n2(tmp_path, ["a0", "b1"], SIZE, scale)
    dataset = r2n2.load(original if scale == 1 else tmp_path, "chair", "test")
    assert (len(dataset), dataset.object_names, dataset.num_views) == (24, ("b1",), 24)
    assert silhouette_iou(dataset, *mesh(1)).min() > 0.92
    vertices, faces = map(torch.from_numpy, mesh(1))
    truth = torch.from_numpy(dataset.voxels)
    iou = {c.name: float(voxel_iou(c.voxelize(vertices, faces), truth)) for c in (R2N2, KATO, KAR)}
    assert iou["r2n2"] > 0.75 and max(iou["kato"], iou["kar"]) < 0.4


def test_half_of_the_field_of_view_is_that_of_a_35_mm_lens_on_a_32_mm_sensor(original):
    dataset = r2n2.load(original, "chair", "train")
    assert 1 / np.tan(np.radians(dataset.poses.half_fov_deg)) == pytest.approx(2.1875)


def test_colours_are_laid_on_white(original):
    dataset = r2n2.load(original, "chair", "train")
    assert dataset.masks is None and not dataset.inverted
    colors, mask = dataset.images[:, :3].transpose(0, 2, 3, 1), dataset.images[:, 3]
    assert (colors[mask == 255] == COLOR).all() and (colors[mask == 0] == 255).all()
    large = r2n2.load(original, "chair", "train", image_size=SIZE)
    assert large.images.shape == (24, 4, SIZE, SIZE)
    np.testing.assert_array_equal(large.masks, mask)


def test_first_four_fifths_of_the_sorted_ids_are_for_training(tmp_path):
    for name in "gfedcba":
        renders(tmp_path, name).mkdir(parents=True)
    assert r2n2.object_ids(tmp_path, "chair", "train") == list("abcde")
    assert r2n2.object_ids(tmp_path, CHAIR, "test") == list("fg")
    assert r2n2.count(tmp_path, "chair", "test") == 2
    assert r2n2.contents(tmp_path) == {CHAIR: ("train", "test")}
    with pytest.raises(ValueError, match="split must be one of train, test; got 'val'"):
        r2n2.load(tmp_path, "chair", "val")


def test_options(original):
    assert len(r2n2.load(original, "chair", "test", views_per_object=5)) == 5
    bins = r2n2.load(original, "chair", "test").with_bins(AngleBins(60, 5, 25, 30))
    assert bins.num_views == 6 and len(set(bins.view_ids.tolist())) > 3
    with pytest.raises(ValueError, match=r"views_per_object must lie in 1 \.\. 24, got 0"):
        r2n2.load(original, "chair", "test", views_per_object=0)
    assert [list(r2n2.problems(original, "chair", split)) for split in ("train", "test")] == [[], []]


def rewrite_row(k, text):
    def change(folder):
        path = renders(folder) / "rendering_metadata.txt"
        rows = path.read_text().splitlines()
        rows[k : k + 1] = [text] if text else []
        path.write_text("\n".join(rows))

    return change


def opaque(folder):
    save(renders(folder) / "02.png", np.zeros((SIZE, SIZE, 3), np.uint8))


FAULTS = {
    "rendering/23.png: is missing": lambda f: (renders(f) / "23.png").unlink(),
    "rendering/00.png: cannot be decoded": lambda f: cut_short(renders(f) / "00.png"),
    "02.png: has the channels RGB; expected RGBA, whose alpha is the mask": opaque,
    "03.png: is 72x60 pixels": lambda f: save(renders(f) / "03.png", np.zeros((60, 72, 4), np.uint8)),
    "rendering_metadata.txt: is missing": lambda f: (renders(f) / "rendering_metadata.txt").unlink(),
    "rendering_metadata.txt: has 23 rows, 24 are needed": rewrite_row(0, ""),
    "rendering_metadata.txt: row 0 is 'inf 25 0 0.8 25'": rewrite_row(0, "inf 25 0 0.8 25"),
    "row 1 has the yaw 10": rewrite_row(1, "10 27 10 0.8 25"),
    "row 1 has azimuth -10, elevation 27 and distance -1.75": rewrite_row(1, "10 27 0 -1 25"),
    "model.binvox: is missing": lambda f: grid(f).unlink(),
    "model.binvox: its runs fill": lambda f: cut_short(grid(f)),
    "rendering: is missing; expected the folder of an object's images": lambda f: shutil.rmtree(renders(f)),
}


@pytest.mark.parametrize("message", FAULTS)
def test_faults_of_an_object_are_named_by_load_and_by_the_scan(folder, message):
    FAULTS[message](folder)
    expect(r2n2, folder, "test", message)


def test_oddities_of_an_object_are_warnings(folder):
    content = grid(folder).read_bytes()
    grid(folder).write_bytes(binvox_bytes(np.zeros((32, 32, 32), bool)))
    expect(r2n2, folder, "test", "model.binvox: the grid is empty", "warning")
    grid(folder).write_bytes(content.replace(b"-0.5 -0.5 -0.5", b"-0.3 -0.5 -0.5"))
    expect(r2n2, folder, "test", "the grid is centred at [0.2, 0.0, 0.0], over half a cell from", "warning")
    grid(folder).write_bytes(content)
    pixels = np.array(Image.open(renders(folder) / "07.png"))
    pixels[..., 3] = 0
    save(renders(folder) / "07.png", pixels)
    expect(r2n2, folder, "test", "07.png: its mask is empty", "warning")


def test_faults_of_the_folder(folder):
    shutil.rmtree(renders(folder, "a0").parent)
    expect(r2n2, folder, "train", "holds 1 objects, which leaves none for train; expected at least 2")
    shutil.rmtree(folder / "ShapeNetRendering" / CHAIR)
    (folder / "ShapeNetRendering" / "02691156").mkdir()
    expect(r2n2, folder, "train", "there is no folder of 'chair'; those here are: 02691156")
    shutil.rmtree(folder / "ShapeNetRendering")
    expect(r2n2, folder, "train", "ShapeNetRendering: there is no such folder")
    assert r2n2.contents(folder) == {}
