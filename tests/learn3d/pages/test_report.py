"""What stands in the page of `learn3d report`."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("plotly")
from plotly.offline import get_plotlyjs

from learn3d.data.readers import kato
from learn3d.evaluation import evaluate
from learn3d.experiments.measurement import evaluate_runs
from learn3d.methods import Grids
from learn3d.pages import report
from learn3d.pages.report import write_report
from learn3d.pages.shapes import UNIT
from learn3d.runs import checkpoint


class Page(HTMLParser):
    """The tags of a page with their attributes, its texts outside of scripts, and the data of its script."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags, self.texts, self.scripts, self._open = [], [], [], None
        self.feed(path.read_text("utf-8"))
        self.data: dict[str, Any] = json.loads(self.scripts[0])

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))
        self._open = tag

    def handle_data(self, text: str) -> None:
        (self.scripts if self._open == "script" else self.texts).append(text) if text.strip() else None

    def handle_endtag(self, tag: str) -> None:
        self._open = None


def read(values: dict[str, str]) -> np.ndarray:
    """The numbers of an array in plotly's form."""
    return np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"])


def test_the_page_asks_for_nothing_from_elsewhere(page) -> None:
    found = Page(page)
    addresses = [value for _, attributes in found.tags for name, value in attributes.items() if name in ("src", "href")]
    assert addresses and all(address.startswith("data:image/png;base64,") for address in addresses)
    policies = [tag[1]["content"] for tag in found.tags if tag[1].get("http-equiv") == "Content-Security-Policy"]
    assert len(policies) == 1 and "default-src 'none'" in policies[0] and "http" not in policies[0]
    assert "http" not in page.read_text("utf-8").replace(get_plotlyjs(), "").replace("http-equiv", "")
    assert page.stat().st_size < 8e6
    assert not list(page.parent.glob(".*"))


def test_no_path_of_the_machine_is_in_it(page, runs, tiny_folder) -> None:
    text = page.read_text("utf-8").replace(get_plotlyjs(), "")
    assert all(str(folder.parent) not in text for folder in (page, *runs, tiny_folder))
    assert "learn3d train --preset peng2020-kato --data DATA --category airplane" in text
    assert "--output OUTPUT" in text


def test_names_are_text(page) -> None:
    found = Page(page)
    assert ("b", {}) not in [tag for tag in found.tags if "one" in tag]
    assert "</script><b>one" in found.texts and found.data["runs"][0]["name"] == "</script><b>one"
    assert page.read_text("utf-8").replace(get_plotlyjs(), "").lower().count("</script>") == 3


def test_names_of_objects_are_text(tmp_path, runs, tiny_set, monkeypatch) -> None:
    hostile = dataclasses.replace(tiny_set, object_names=("<img src=x onerror=a()>", "{{ 7 * 7 }}", "\u202eabc\x1b"))
    monkeypatch.setattr(checkpoint, "load_data", lambda *_, **__: hostile)
    write_report(runs, tmp_path / "page.html")
    found = Page(tmp_path / "page.html")
    assert {item["name"] for item in found.data["items"]} == {*hostile.object_names[:2], r"\u202eabc\x1b"}
    assert all(attributes.get("src", "data:").startswith("data:") for _, attributes in found.tags)


@pytest.mark.parametrize("which", ["last", "best"])
def test_figures_are_those_of_evaluate(tmp_path, runs, which) -> None:
    path = tmp_path / "page.html"
    write_report(runs, path, split="train", which=which)
    wanted = evaluate_runs(runs, split="train", which=which)
    found = Page(path)
    rows = re.findall(r"<b>(.+)</b> \[(.+), (.+)\]</td>\n<td>[^<]*</td><td>([^<]+)</td>", path.read_text())
    assert len(rows) == 2 and rows[0] != rows[1]
    for (iou, low, high, mmd), result in zip(rows, wanted, strict=True):
        assert (iou, mmd) == (f"{result.voxel_iou_kato18:.3f}", f"{result.mmd:.3f}")
        assert float(low) <= float(iou) <= float(high)
    method, config, _ = checkpoint.load_method(checkpoint.find(runs[0], which))
    dataset = checkpoint.load_data(config, "train")
    ious = evaluate(method, dataset).ious["kato18"].numpy()
    for item in found.data["items"]:
        own = ious[dataset.object_ids == dataset.object_ids[item["index"]]]
        assert item["ious"][0] == pytest.approx(ious[item["index"]], abs=1e-4)
        assert item["means"][0] == pytest.approx(own.mean(), abs=1e-4)
    by_view = found.data["views"][0]
    assert len(by_view["azimuths"]) == 24 and np.mean(by_view["ious"]) == pytest.approx(ious.mean(), abs=1e-4)


def test_objects_go_from_the_best_to_the_worst(page) -> None:
    items = Page(page).data["items"]
    means = [np.mean(item["means"]) for item in items]
    rows = re.findall(
        r"<tr( data-item=\"\d+\")?><th scope=\"row\">(?:<button type=\"button\">)?(\d+)", page.read_text()
    )
    assert len(items) == 2 and means[0] > means[1]
    assert [bool(shown) for shown, _ in rows] == [True, False, True], "the best and the worst of three have shapes"
    assert [rows[0][1], rows[2][1]] == [item["name"] for item in items]


def test_chosen_images_are_shown(tmp_path, runs) -> None:
    write_report(runs[:1], tmp_path / "page.html", split="train", indices=(3, 50, 3))
    items = Page(tmp_path / "page.html").data["items"]
    assert sorted(item["index"] for item in items) == [3, 50]
    assert {item["name"] for item in items} == {"0000", "0002"}


def test_meshes_are_those_of_the_networks_seen_as_in_mesh_files(page, runs) -> None:
    data = Page(page).data
    item = data["items"][0]
    method, config, _ = checkpoint.load_method(runs[1] / "last.safetensors")
    shape = method.decode(method.encode(checkpoint.load_data(config, "train").batch([item["index"]]).images))
    mesh, faces = item["meshes"][1], data["faces"][item["meshes"][1]["faces"]]
    points = np.stack([read(mesh[axis]) for axis in "xyz"], axis=1) * UNIT
    x, y, z = shape.vertices[0].numpy().T
    assert np.allclose(points, np.stack([-z, x, y], axis=1), atol=UNIT), "z is up, x the front, right-handed"
    triangles = np.stack([read(faces[axis]) for axis in "ijk"], axis=1)
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    assert (a * np.cross(b, c)).sum() > 0, "a volume: normals point outwards"
    assert len(data["faces"]) == 3, "triangles of the runs are stored once, those of each true shape apart"
    assert len(item["meshes"]) == 3


def test_a_true_shape_is_the_surface_of_its_voxels(page, runs) -> None:
    item = Page(page).data["items"][0]
    _, config, _ = checkpoint.load_method(runs[0] / "last.safetensors")
    dataset = checkpoint.load_data(config, "train")
    voxels = dataset.convention.to_object(dataset.batch([item["index"]]).voxels)[0].numpy()
    sides = np.array([np.ptp(np.flatnonzero(voxels.any(axis=other))) + 1 for other in ((1, 2), (0, 2), (0, 1))]) / 32
    found = [np.ptp(read(item["meshes"][2][axis])) * UNIT for axis in "xyz"]
    assert np.allclose(found, sides[[2, 0, 1]], atol=1e-3)


def test_voxels_of_a_method_become_surfaces(tmp_path, runs, monkeypatch) -> None:
    def boxes(self, codes):
        occupancy = codes.new_zeros(len(codes), 32, 32, 32)
        occupancy[:, 8:24, 8:24, 8:24] = 1
        return Grids(occupancy)

    monkeypatch.setattr(type(checkpoint.load_method(runs[1] / "last.safetensors")[0]), "decode", boxes)
    write_report(runs[1:], tmp_path / "page.html")
    mesh = Page(tmp_path / "page.html").data["items"][0]["meshes"][0]
    assert np.ptp(read(mesh["x"])) * UNIT == pytest.approx(0.5, abs=1e-3)


def test_data_without_truth_or_poses_and_files_without_a_log(tmp_path, runs, tiny_set, monkeypatch) -> None:
    blind = dataclasses.replace(tiny_set, voxels=None)
    monkeypatch.setattr(checkpoint, "load_data", lambda *_, **__: blind)
    write_report([runs[0] / "last.safetensors"], tmp_path / "page.html")
    found = Page(tmp_path / "page.html")
    assert found.data["kind"] == "silhouette IoU" and len(found.data["items"][0]["meshes"]) == 1
    assert found.data["curves"] == []
    monkeypatch.setattr(checkpoint, "load_data", lambda *_, **__: dataclasses.replace(blind, poses=None))
    write_report(runs, tmp_path / "page.html")
    found = Page(tmp_path / "page.html")
    assert found.data["views"] == [] and found.data["items"][0]["ious"] == [None, None]


def test_curves_are_those_of_the_log(page, runs, read_metrics) -> None:
    curves = {curve["title"]: curve for curve in Page(page).data["curves"]}
    logged = [line for line in read_metrics(runs[1]) if line["split"] == "val"]
    assert next(iter(curves)) == "voxel IoU, val"
    assert curves["voxel IoU, val"]["steps"][1] == [line["step"] for line in logged] == [2, 4, 6]
    assert curves["voxel IoU, val"]["values"][1] == pytest.approx([line["voxel_iou"] for line in logged], rel=1e-5)
    assert curves["prior loss, train"]["steps"][1] is None, "the second method has no such loss"


def test_the_command_writes_the_page(tmp_path, runs, tiny_folder, command) -> None:
    words = ("report", *runs, "--data", tiny_folder, "--output", tmp_path / "page.html", "--labels", "one", "two")
    status, out, _ = command(*words)
    assert status == 0 and out.startswith(f"{tmp_path / 'page.html'} (") and out.endswith(" MB)\n")
    assert [run["name"] for run in Page(tmp_path / "page.html").data["runs"]] == ["one", "two"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--output {tmp}/page.html", "give at least one run"),
        ("{run} --output {tmp}/no/page.html", "give another --output"),
        ("{run} {tmp}/no --output {tmp}/page.html", "there is no checkpoint"),
        ("{run} --category chair --output {tmp}/page.html", "chair"),
        ("{run} --category chair,sofa --output {tmp}/page.html", "one class"),
        ("{run} --data {tmp}/no --output {tmp}/page.html", "--data"),
        ("{run} --indices 24 --output {tmp}/page.html", "indices must lie in 0 .. 23"),
        ("{run} --objects 0 --output {tmp}/page.html", "of 1 to 100 images, and 0 are"),
        ("{run} --objects 101 --output {tmp}/page.html", "of 1 to 100 images, and 101 are"),
        ("{run} --labels a b --output {tmp}/page.html", "one label per run"),
    ],
)
def test_mistakes_are_one_clear_line(words: str, message: str, runs, tmp_path, command) -> None:
    status, _, said = command("report", *words.format(run=runs[0], tmp=tmp_path).split())
    assert status == 1 and not (tmp_path / "page.html").exists()
    last = said.splitlines()[-1]
    assert last.startswith("error: ") and message in last


def test_runs_of_different_classes_or_data_are_told(runs, tmp_path, monkeypatch, tiny_set) -> None:
    load = checkpoint.load_metadata

    def other(**changes):
        def changed(path):
            about = load(path)
            config = dataclasses.replace(about.config, **(changes if path.parent == runs[1] else {}))
            return dataclasses.replace(about, config=config)

        monkeypatch.setattr(report.checkpoint, "load_metadata", changed)

    other(category="chair")
    with pytest.raises(ValueError, match="one class, and these runs are of airplane, chair"):
        write_report(runs, tmp_path / "page.html")
    other(data=tmp_path)
    with pytest.raises(ValueError, match="say with --data on which"):
        write_report(runs, tmp_path / "page.html")
    monkeypatch.undo()


def test_runs_that_read_different_images_are_told(runs, tmp_path, monkeypatch, tiny_set) -> None:
    first = report.open_runs(runs)
    images, voxels = np.zeros((1, 24, 4, 64, 64), np.uint8), np.zeros((1, 32, 32, 32), bool)
    other = kato.from_arrays(images, voxels, category="airplane", split="test")
    mixed = [dataclasses.replace(first[0], dataset=tiny_set), dataclasses.replace(first[1], dataset=other)]
    monkeypatch.setattr(report, "open_runs", lambda *_, **__: mixed)
    with pytest.raises(ValueError, match="read different images"):
        write_report(runs, tmp_path / "page.html")


def test_a_run_without_a_log_has_no_curves(runs, tmp_path) -> None:
    run = shutil.copytree(runs[0], tmp_path / "run", ignore=shutil.ignore_patterns("metrics.jsonl"))
    assert write_report([run], tmp_path / "report.html", split="train", objects=2) > 0
