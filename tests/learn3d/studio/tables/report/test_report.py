"""What stands in the page of `learn3d report`."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("plotly")
from plotly.offline import get_plotlyjs

from learn3d.evaluation import evaluate
from learn3d.runs import checkpoint
from learn3d.runs.measurement import evaluate_runs
from learn3d.studio.tables import report
from learn3d.studio.tables.report import UNIT, write_report


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
        (self.scripts if self._open == "script" else self.texts).append(
            text
        ) if text.strip() else None

    def handle_endtag(self, tag: str) -> None:
        self._open = None


def read(values: dict[str, str]) -> np.ndarray:
    """The numbers of an array in plotly's form."""
    return np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"])


def test_the_page_asks_for_nothing_from_elsewhere(page) -> None:
    found = Page(page)
    addresses = [
        value
        for _, attributes in found.tags
        for name, value in attributes.items()
        if name in ("src", "href")
    ]
    assert addresses and all(address.startswith("data:image/png;base64,") for address in addresses)
    policies = [
        tag[1]["content"]
        for tag in found.tags
        if tag[1].get("http-equiv") == "Content-Security-Policy"
    ]
    assert len(policies) == 1 and "default-src 'none'" in policies[0] and "http" not in policies[0]
    assert "http" not in page.read_text("utf-8").replace(get_plotlyjs(), "").replace(
        "http-equiv", ""
    )
    assert page.stat().st_size < 8e6
    assert not list(page.parent.glob(".*"))


def test_no_path_of_the_machine_is_in_it(page, runs, tiny_folder) -> None:
    text = page.read_text("utf-8").replace(get_plotlyjs(), "")
    assert all(str(folder.parent) not in text for folder in (page, *runs, tiny_folder))
    assert "learn3d train --preset peng2020-kato --data DATA --category airplane" in text
    assert "--output OUTPUT" in text


def test_names_are_text(page, tmp_path, runs, tiny_set, monkeypatch) -> None:
    assert (
        "</script><b>one" in Page(page).texts
        and Page(page).data["runs"][0]["name"] == "</script><b>one"
    )
    assert page.read_text("utf-8").replace(get_plotlyjs(), "").lower().count("</script>") == 3
    hostile = dataclasses.replace(
        tiny_set, object_names=("<img src=x onerror=a()>", "{{ 7 * 7 }}", "\u202eabc\x1b")
    )
    monkeypatch.setattr(checkpoint, "load_data", lambda *_, **__: hostile)
    write_report(runs, tmp_path / "page.html")
    found = Page(tmp_path / "page.html")
    assert {item["name"] for item in found.data["items"]} == {
        *hostile.object_names[:2],
        r"\u202eabc\x1b",
    }
    assert all(attributes.get("src", "data:").startswith("data:") for _, attributes in found.tags)


def test_figures_are_those_of_evaluate(page, runs) -> None:
    wanted, found = list(evaluate_runs(runs, split="train")), Page(page)
    rows = re.findall(
        r"<b>(.+)</b> \[(.+), (.+)\]</td>\n<td>[^<]*</td><td>([^<]+)</td>", page.read_text()
    )
    assert len(rows) == 2 and rows[0] != rows[1]
    for (iou, low, high, mmd), result in zip(rows, wanted, strict=True):
        assert (iou, mmd) == (f"{result.voxel_iou:.3f}", f"{result.mmd:.3f}")
        assert float(low) <= float(iou) <= float(high)
    method, config, _ = checkpoint.load_method(runs[0])
    dataset = checkpoint.load_data(config, "train")
    ious = evaluate(method, dataset).values["voxel_iou"].numpy()
    for item in found.data["items"]:
        own = ious[dataset.object_ids == dataset.object_ids[item["index"]]]
        assert item["ious"][0] == pytest.approx(ious[item["index"]], abs=1e-4)
        assert item["means"][0] == pytest.approx(own.mean(), abs=1e-4)
    by_view = found.data["views"][0]
    assert len(by_view["azimuths"]) == 24 and np.mean(by_view["ious"]) == pytest.approx(
        ious.mean(), abs=1e-4
    )


def test_objects_go_from_the_best_to_the_worst(page) -> None:
    items = Page(page).data["items"]
    means = [np.mean(item["means"]) for item in items]
    rows = re.findall(
        r"<tr( data-item=\"\d+\")?><th scope=\"row\">(?:<button type=\"button\">)?(\d+)",
        page.read_text(),
    )
    assert len(items) == 2 and means[0] > means[1]
    assert [bool(shown) for shown, _ in rows] == [True, False, True], (
        "the best and the worst of three have shapes"
    )
    assert [rows[0][1], rows[2][1]] == [item["name"] for item in items]


def test_meshes_are_those_of_the_networks_seen_as_in_mesh_files(page, runs) -> None:
    item = Page(page).data["items"][0]
    method, config, _ = checkpoint.load_method(runs[1] / "last.safetensors")
    shape = method.decode(
        method.encode(checkpoint.load_data(config, "train").batch([item["index"]]).images)
    )
    mesh = item["meshes"][1]
    points = np.stack([read(mesh[axis]) for axis in "xyz"], axis=1) * UNIT
    x, y, z = shape.vertices[0].numpy().T
    assert np.allclose(points, np.stack([-z, x, y], axis=1), atol=UNIT), (
        "z is up, x the front, right-handed"
    )
    triangles = np.stack([read(mesh[axis]) for axis in "ijk"], axis=1)
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    assert (a * np.cross(b, c)).sum() > 0, "a volume: normals point outwards"
    assert len(item["meshes"]) == 3
    dataset = checkpoint.load_data(config, "train")
    voxels = dataset.convention.to_object(dataset.batch([item["index"]]).voxels)[0].numpy()
    sides = (
        np.array(
            [
                np.ptp(np.flatnonzero(voxels.any(axis=other))) + 1
                for other in ((1, 2), (0, 2), (0, 1))
            ]
        )
        / 32
    )
    found = [np.ptp(read(item["meshes"][2][axis])) * UNIT for axis in "xyz"]
    assert np.allclose(found, sides[[2, 0, 1]], atol=0.02), (
        "the true shape is the surface of its voxels, smoothed"
    )


def test_data_without_truth_or_poses_and_files_without_a_log(
    tmp_path, runs, tiny_set, monkeypatch
) -> None:
    blind = dataclasses.replace(tiny_set, voxels=None)
    monkeypatch.setattr(checkpoint, "load_data", lambda *_, **__: blind)
    write_report([runs[0] / "last.safetensors"], tmp_path / "page.html")
    found = Page(tmp_path / "page.html")
    assert found.data["kind"] == "silhouette IoU" and len(found.data["items"][0]["meshes"]) == 1
    assert found.data["curves"] == []
    monkeypatch.setattr(
        checkpoint, "load_data", lambda *_, **__: dataclasses.replace(blind, poses=None)
    )
    write_report(runs, tmp_path / "page.html")
    found = Page(tmp_path / "page.html")
    assert found.data["views"] == [] and found.data["items"][0]["ious"] == [None, None]


def test_curves_are_those_of_the_log(page, runs, read_metrics) -> None:
    curves = {curve["title"]: curve for curve in Page(page).data["curves"]}
    logged = [line for line in read_metrics(runs[1]) if line["split"] == "val"]
    assert next(iter(curves)) == "voxel IoU, val"
    assert curves["voxel IoU, val"]["steps"][1] == [line["step"] for line in logged] == [2, 4, 6]
    assert curves["voxel IoU, val"]["values"][1] == pytest.approx(
        [line["voxel_iou"] for line in logged], rel=1e-4
    )
    assert curves["prior loss, train"]["steps"][1] is None, "the second method has no such loss"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--output {tmp}/page.html", "give at least one run"),
        ("{run} {tmp}/no --output {tmp}/page.html", "there is no checkpoint"),
        ("{run} --category chair --output {tmp}/page.html", "is missing"),
        ("{run} --objects 101 --output {tmp}/page.html", "of 1 to 100 images, got 101"),
    ],
)
def test_mistakes_are_one_clear_line(words: str, message: str, runs, tmp_path, command) -> None:
    status, _, said = command("report", *words.format(run=runs[0], tmp=tmp_path).split())
    assert status == 1 and not (tmp_path / "page.html").exists()
    last = said.splitlines()[-1]
    assert last.startswith("error: ") and message in last


@pytest.mark.parametrize(
    ("change", "config", "message"),
    [
        (
            {"category": "chair"},
            {},
            "one class, and these runs are of airplane, chair; give --category",
        ),
        ({}, {"data": Path("elsewhere")}, "trained on different data .*elsewhere.*; give --data"),
        ({"object_names": ("other",)}, {}, "read different images"),
    ],
)
def test_runs_that_cannot_be_compared_are_told(
    runs, tmp_path, monkeypatch, change, config, message
) -> None:
    first, second = report.open_runs(runs)
    metadata = dataclasses.replace(
        second.metadata, config=dataclasses.replace(second.metadata.config, **config)
    )
    other = dataclasses.replace(
        second, dataset=dataclasses.replace(second.dataset, **change), metadata=metadata
    )
    monkeypatch.setattr(report, "open_runs", lambda *_, **__: [first, other])
    with pytest.raises(ValueError, match=message):
        write_report(runs, tmp_path / "page.html")
