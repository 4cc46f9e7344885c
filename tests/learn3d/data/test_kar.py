"""The renderings of Kar et al., written to their description: what is read, which protocol, and faults named."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import scipy.io
import torch
from PIL import Image
from reader_checks import cut_short, expect, silhouette_iou
from shapenet_files import CHAIR, COLOR, box_mesh, save, shapes, swap_frames, write_kar

from learn3d.data.conventions import KATO
from learn3d.data.readers import kar
from learn3d.data.readers.kar import KAR
from learn3d.data.readers.r2n2 import R2N2
from learn3d.data.view_bins import AngleBins
from nmr.metrics import voxel_iou

LISTS = {"train": ["b1"], "val": ["c2"], "test": ["a0"]}
SIZE = 80  # the real renders have 224 pixels


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kar")
    write_kar(folder, LISTS, SIZE)
    return folder


@pytest.fixture
def folder(original, tmp_path):
    return shutil.copytree(original, tmp_path / "kar")


def renders(folder, name="a0"):
    return folder / "renders" / CHAIR / name


def volume(folder, name="a0"):
    return folder / "voxels" / "modelVoxels32" / CHAIR / f"{name}.mat"


def mesh(number: int) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = box_mesh(shapes(3)[number])
    return swap_frames(vertices), faces


def test_renders_voxels_and_cameras_agree_with_the_object_that_they_were_made_from(original):
    dataset = kar.load(original, "chair", "test")
    assert (len(dataset), dataset.num_objects, dataset.object_names) == (20, 1, ("a0",))
    assert silhouette_iou(dataset, *mesh(0)).min() > 0.94
    vertices, faces = map(torch.from_numpy, mesh(0))
    truth = torch.from_numpy(dataset.voxels)
    iou = {c.name: float(voxel_iou(c.voxelize(vertices, faces), truth)) for c in (KAR, KATO, R2N2)}
    assert iou["kar"] > 0.75 and max(iou["kato"], iou["r2n2"]) < 0.4
    assert dataset.poses.half_fov_deg == pytest.approx(14.9314, abs=1e-4)


def test_protocol_of_the_published_code(original):
    train = kar.load(original, "chair", "train")
    assert (len(train), train.object_names) == (1, ("b1",))  # render 0 alone
    everything = kar.load(original, "chair", "train", views_per_object=20)
    np.testing.assert_array_equal(train.images[0], everything.images[0])
    assert (
        len(kar.load(original, "chair", "val")) == 20
        and len(kar.load(original, "chair", "val", views_per_object=3)) == 3
    )
    assert everything.num_views == 72 and len(set(everything.view_ids.tolist())) > 10
    table = np.loadtxt(renders(original, "b1") / "view.txt")
    wanted = (table[:, 0] + 180) // 15 * 3 + (table[:, 1] + 20) // 20
    np.testing.assert_array_equal(everything.view_ids, wanted)
    coarse = kar.load(original, "chair", "train").with_bins(AngleBins(60, 60))
    assert coarse.num_views == 6


def test_colours_stay_as_they_are_over_white_and_borders_are_averaged(original):
    dataset = kar.load(original, "chair", "test")
    assert dataset.masks is None and not dataset.inverted
    colors, mask = dataset.images[:, :3].transpose(0, 2, 3, 1), dataset.images[:, 3]
    assert (colors[mask == 255] == COLOR).all() and (colors[mask == 0] == 255).all()
    assert len(np.unique(mask)) > 2
    exact = np.asarray(Image.open(renders(original) / "depth_0.png")) < 250
    assert mask[0].mean() / 255 == pytest.approx(exact.mean(), abs=1e-3)


def test_large_images_keep_their_size_and_masks_have_64_pixels(original):
    dataset = kar.load(original, "chair", "test", image_size=SIZE)
    assert dataset.images.shape == (20, 4, SIZE, SIZE) and dataset.masks.shape == (20, 64, 64)
    assert set(np.unique(dataset.images[:, 3])) == {0, 255}
    np.testing.assert_array_equal(dataset.masks, kar.load(original, "chair", "test").images[:, 3])


def test_objects_may_have_fewer_renders(folder):
    for k in range(12, 20):
        for name in (f"render_{k}.png", f"depth_{k}.png"):
            (renders(folder) / name).unlink()
    table = renders(folder) / "view.txt"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:12]))
    assert len(kar.load(folder, "chair", "test")) == 12
    assert not list(kar.problems(folder, "chair", "test"))


@pytest.mark.parametrize("form", ["16 bits", "RGB", "no depth"])
def test_other_forms_of_the_mask_give_the_same_images(folder, form):
    wanted = kar.load(folder, "chair", "test", views_per_object=1).images
    path, depth_path = renders(folder) / "render_0.png", renders(folder) / "depth_0.png"
    depth = np.asarray(Image.open(depth_path))
    if form == "16 bits":
        save(depth_path, np.where(depth < 250, 249 * 256 + 255, 250 * 256).astype(np.uint16))
    elif form == "RGB":
        save(depth_path, np.dstack([depth] * 3))
    else:
        depth_path.unlink()
        alpha = np.where(depth < 250, 255, 0).astype(np.uint8)
        save(path, np.dstack([np.asarray(Image.open(path)) * (alpha > 0)[..., None], alpha]))
    np.testing.assert_array_equal(kar.load(folder, "chair", "test", views_per_object=1).images, wanted)


def test_broken_renders_are_left_out(folder):
    lists = json.loads((folder / "splits.json").read_text())
    lists[CHAIR]["test"] = [*sorted(kar.BROKEN), "a0"]
    (folder / "splits.json").write_text(json.dumps(lists))
    assert len(kar.BROKEN) == 3 and kar.load(folder, "chair", "test").object_names == ("a0",)
    assert list(kar.problems(folder, "chair", "test")) == [] and kar.count(folder, "chair", "test") == 1


def test_contents(original):
    assert kar.contents(original) == {CHAIR: ("train", "val", "test")}
    for split in LISTS:
        assert list(kar.problems(original, "chair", split)) == []


def rewrite_row(k, text):
    def change(folder):
        rows = (renders(folder) / "view.txt").read_text().splitlines()
        rows[k : k + 1] = [text] if text else []
        (renders(folder) / "view.txt").write_text("\n".join(rows))

    return change


def no_mask(folder):
    (renders(folder) / "depth_3.png").unlink()


FAULTS = {
    "render_19.png: is missing": lambda f: (renders(f) / "render_19.png").unlink(),
    "render_0.png: cannot be decoded as an image": lambda f: cut_short(renders(f) / "render_0.png"),
    "render_1.png: is 80x70 pixels; expected a square image of at least 64x64": lambda f: save(
        renders(f) / "render_1.png", np.zeros((70, 80, 3), np.uint8)
    ),
    "render_1.png: is 60x60 pixels": lambda f: save(renders(f) / "render_1.png", np.zeros((60, 60, 3), np.uint8)),
    "render_1.png: has the pixel format I;16": lambda f: save(
        renders(f) / "render_1.png", np.zeros((80, 80), np.uint16)
    ),
    "depth_3.png: is missing, and render_3.png has no alpha channel": no_mask,
    "depth_4.png: is 90x90 pixels, but render_4.png is 80x80": lambda f: save(
        renders(f) / "depth_4.png", np.zeros((90, 90), np.uint8)
    ),
    "depth_5.png: cannot be decoded": lambda f: cut_short(renders(f) / "depth_5.png"),
    "view.txt: is missing": lambda f: (renders(f) / "view.txt").unlink(),
    "view.txt: cannot be read": lambda f: (renders(f) / "view.txt").write_bytes(b"\xff\xfe\x00"),
    "view.txt: has 19 rows, 20 are needed": rewrite_row(3, ""),
    "view.txt: row 3 is '1 2 x 4'": rewrite_row(3, "1 2 x 4"),
    "view.txt: row 2 is '1 2'": rewrite_row(2, "1 2"),
    "view.txt: row 4 is '1 nan 0 2'": rewrite_row(4, "1 nan 0 2"),
    "view.txt: row 4 has azimuth 1e+30": rewrite_row(4, "1e30 5 0 2"),
    "view.txt: row 4 has azimuth 1, elevation 95 and distance 2": rewrite_row(4, "1 95 0 2"),
    "view.txt: row 4 has azimuth 1, elevation 5 and distance 0": rewrite_row(4, "1 5 0 0"),
    "a0.mat: is missing": lambda f: volume(f).unlink(),
    "a0.mat: cannot be read": lambda f: volume(f).write_bytes(b"MATLAB 5.0 nonsense" * 20),
    "a0.mat: has no such array": lambda f: scipy.io.savemat(volume(f), {"volume": np.ones((32, 32, 32))}),
    "a0.mat: has numbers [16, 16, 16]": lambda f: scipy.io.savemat(volume(f), {"Volume": np.ones((16, 16, 16))}),
    "a0: is missing; expected the folder of an object": lambda f: shutil.rmtree(renders(f)),
}


@pytest.mark.parametrize("message", FAULTS)
def test_faults_of_an_object_are_named_by_load_and_by_the_scan(folder, message):
    FAULTS[message](folder)
    expect(kar, folder, "test", message)


def test_oddities_of_an_object_are_warnings(folder):
    scipy.io.savemat(volume(folder), {"Volume": np.zeros((32, 32, 32), np.uint8)})
    expect(kar, folder, "test", "a0.mat: the grid is empty", "warning")
    save(renders(folder, "b1") / "depth_0.png", np.full((SIZE, SIZE), 255, np.uint8))
    expect(kar, folder, "train", "render_0.png: its mask is empty", "warning")


LIST_FAULTS = {
    "splits.json: cannot be read as JSON": "{",
    "splits.json: has another structure": '{"03001627": {"test": "a0"}}',
    "has another structure; expected": '["03001627"]',
    "has no entry 03001627 (chair); it has: 02691156": '{"02691156": {"test": ["a0"]}}',
    "names the object '../../../etc'; expected the plain name": '{"03001627": {"test": ["../../../etc"]}}',
    "names the object '..'; expected the plain name": '{"03001627": {"test": [".."]}}',
    "names the object '/etc'; expected the plain name": '{"03001627": {"test": ["/etc"]}}',
    "cannot be read as JSON (it is nested too deeply)": "[" * 100_000,
    "names no object for 03001627 (chair), test": '{"03001627": {"test": []}}',
}


@pytest.mark.parametrize("message", LIST_FAULTS)
def test_faults_of_the_lists(folder, message):
    (folder / "splits.json").write_text(LIST_FAULTS[message])
    expect(kar, folder, "test", message)


def test_lists_that_are_absent_or_overlap(folder):
    (folder / "splits.json").write_text(json.dumps({CHAIR: LISTS | {"test": ["a0", "a0"]}}))
    expect(kar, folder, "test", "chair test lists a0 more than once", "warning")
    (folder / "splits.json").write_text(json.dumps({CHAIR: LISTS | {"test": ["c2"]}}))
    expect(kar, folder, "test", "chair test shares 1 objects with val, such as c2", "warning")
    (folder / "splits.json").unlink()
    expect(kar, folder, "test", "splits.json: is missing: take data/splits.json of the LSM code")
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        kar.load(folder / "nowhere", "chair", "test")


def test_options_out_of_range(original):
    with pytest.raises(ValueError, match=r"views_per_object must lie in 1 \.\. 20, got 21"):
        kar.load(original, "chair", "test", views_per_object=21)
    with pytest.raises(ValueError, match="is 80x80 pixels; expected a square image of at least 224x224"):
        kar.load(original, "chair", "test", image_size=224)
    with pytest.raises(ValueError, match="split must be one of train, val, test"):
        kar.load(original, "chair", "all")
