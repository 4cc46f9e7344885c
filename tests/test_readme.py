"""The code of the README and of the pages in docs runs, and the files that they name exist.

Our own code is in blocks marked ``python``. Code of other libraries is not run; its blocks are marked ``py``.
"""

import re
import shlex
import sys
from pathlib import Path

import imageio.v3 as imageio
import pytest
import torch
import trimesh
import tyro

from learn3d.commands import main

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]


def run(page):
    """Executes the blocks of a page, in order, in one namespace, which is returned."""
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL):
        exec(block, names)
    return names


def test_readme_fits_a_mesh_that_is_right_from_all_sides(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = run(README)
    assert len(capsys.readouterr().out.splitlines()) == 5
    nmr, points, triangles = names["nmr"], names["points"], names["triangles"]
    fitted = trimesh.load(tmp_path / "fitted.glb", force="mesh")
    vertices, faces = torch.tensor(fitted.vertices, dtype=torch.float32), torch.tensor(fitted.faces)
    sides = [0.0, 50.0, -15.0] * 5, [24.0 * k + 11 for k in range(15)]
    new = nmr.LookAt.from_angles(2.732, *sides, half_fov_deg=12.0, right_handed=True)
    ours = nmr.render_silhouette(vertices, faces, new, fill_back=False, image_size=128)
    theirs = nmr.render_silhouette(points, triangles, new, image_size=128)
    assert nmr.losses.soft_iou_loss(ours, theirs) < 0.08  # at cameras that the fit did not have
    assert fitted.is_watertight and fitted.volume > 0
    colors = fitted.visual.vertex_colors[:, :3].astype(float).mean(0)
    assert colors[0] > 2 * colors[1:].max()  # a red car
    picture = imageio.imread(tmp_path / "fitted.png")
    assert picture.shape == (256, 768, 3) and 0.1 < (picture < 250).any(-1).mean() < 0.6


def test_from_pytorch3d_draws_the_same_picture_both_ways():
    names = run(ROOT / "docs" / "from-pytorch3d.md")
    rgb, alpha, same = names["rgb"], names["alpha"], names["same"]
    assert rgb.shape == (1, 256, 256, 3) and alpha.shape == (1, 256, 256)
    assert 0.2 < alpha.mean() < 0.8
    assert (rgb - same).abs().max(-1).values.gt(1e-3).float().mean() < 1e-3  # but for edges that round differently
    # The sphere's colours are its coordinates: in both worlds x grows to the right, y to the top.
    assert rgb[0, 128, 180, 0] > rgb[0, 128, 70, 0] and rgb[0, 70, 128, 1] > rgb[0, 180, 128, 1]
    # Nearest to the eye, which is at z = 2.7, is the greatest z.
    assert rgb[0, 128, 128, 2] > 0.9
    names["uv"] = torch.tensor([[0.0, 0.0], [1.0, 1.0], [3 / 127, 5 / 63]])
    exec(re.findall(r"^uv = \(.*$", (ROOT / "docs" / "from-pytorch3d.md").read_text(), flags=re.MULTILINE)[0], names)
    texels = names["uv"] * torch.tensor([128, 64]) - 0.5  # a texel centre of align_corners=True is one of ours
    torch.testing.assert_close(texels, torch.tensor([[0.0, 0.0], [127.0, 63.0], [3.0, 5.0]]), atol=1e-4, rtol=0)


def test_from_nvdiffrast_draws_the_same_picture_three_ways():
    names = run(ROOT / "docs" / "from-nvdiffrast.md")
    image = names["image"]
    assert image.shape == (1, 256, 256, 3) and 0.1 < (image != 1).any(-1).float().mean() < 0.9
    torch.testing.assert_close(names["same"], image, atol=0, rtol=0)
    assert (names["also"] - image).abs().max(-1).values.gt(1e-3).float().mean() < 1e-3
    assert names["dr"].__name__ == "nmr.nvdiffrast.torch" and names["pos"].grad.abs().sum() > 0
    assert names["drawn"][0, 30, 30].argmax() == 0 and names["drawn"][0, 200, 30].argmax() == 2  # row 0 is the bottom
    assert names["zeros"].device.type == "cpu"


def test_from_neural_renderer_maps_of_forks():
    names = run(ROOT / "docs" / "from-neural-renderer.md")
    index, same, visible = names["face_index"], names["same"], names["visible"]
    assert index.shape == (2, 64, 64) and torch.equal(index, same)
    assert visible.shape == (2, 320)
    for b in range(2):  # the near side of a sphere
        assert set(visible[b].nonzero()[:, 0].tolist()) == set(index[b].unique().tolist()) - {-1}
        assert 60 < visible[b].sum() < 160


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_run_and_what_they_name_exists(page):
    tested_elsewhere = ("README.md", "from-pytorch3d.md", "from-nvdiffrast.md", "development.md")
    if page.name not in tested_elsewhere:  # above, and in learn3d/methods/test_development.py
        run(page)
    text = page.read_text()
    named = re.findall(r"(?:tools|docs|csrc|nmr|learn3d|tests)/[\w./-]*\w\.(?:py|sh|md|png|cpp|ipynb)", text)
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", text)
    missing = [name for name in {*named} if not (ROOT / name).exists()]
    missing += [link for link in {*links} if "://" not in link and not (page.parent / link).exists()]
    assert missing == []
    assert page != README or len(named) > 5


def commands():
    """The command lines `learn3d ...` in the blocks of all pages."""
    for page in [*PAGES, *sorted((ROOT / "docs" / "methods").glob("*.md"))]:
        for block in re.findall(r"```sh\n(.*?)```", page.read_text(), flags=re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line.replace("SEED", "0"), comments=True)
                if words[:1] == ["learn3d"] and not {"...", "COMMAND", "--list"} & set(words):
                    yield pytest.param(words[1:], id=f"{page.name}: {' '.join(words)}")


class Understood(Exception):
    pass


@pytest.mark.parametrize("words", list(commands()))
def test_documented_commands_are_understood(words, monkeypatch):
    parse = tyro.cli

    def parse_only(*args, **options):
        parse(*args, **options)
        raise Understood

    monkeypatch.setattr(tyro, "cli", parse_only)
    monkeypatch.setattr(sys, "argv", ["learn3d"])
    with pytest.raises(Understood):
        main(*words)
