"""The files beside a data set that say how it was made: card, report and contact sheet."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from learn3d.data import conventions
from learn3d.data.categories import synset_of
from learn3d.files.writing import write_json
from learn3d.make_data.config import HOW, DatasetConfig
from learn3d.make_data.writers import WRITERS, Writer
from learn3d.make_data.writers.writer import write_png
from learn3d.pictures.contact_sheet import LEGEND, draw_sheet
from learn3d.terminal import plain

MOST_LISTED = 100  # skipped meshes in the text of a report; its JSON lists all


@dataclass(frozen=True)
class DatasetReport:
    """What `make_dataset` did."""

    category: str
    files: list[str]  # files and folders written, relative to the output folder
    objects: dict[str, int]  # objects per split, augmented copies included
    used: list[dict]  # per mesh: object, name, split, vertices, faces, watertight
    skipped: list[dict]  # per mesh: name, split, reason
    ignored_files: dict[str, int]  # files in the source folder that are no meshes, per extension
    warnings: list[str]  # what the data set cannot be used for

    def text(self) -> str:
        """The report for people."""
        faces = np.array([mesh["faces"] for mesh in self.used])
        watertight = sum(mesh["watertight"] for mesh in self.used)
        lines = [
            f"{self.category}: {len(self.used)} meshes used, {len(self.skipped)} skipped",
            "objects: " + ", ".join(f"{split} {count}" for split, count in self.objects.items()),
            f"faces per mesh: {faces.min()} .. {faces.max()}, median {int(np.median(faces))}; watertight: {watertight}",
        ]
        lines += [f"skipped {mesh['name']} ({mesh['split']}): {mesh['reason']}" for mesh in self.skipped[:MOST_LISTED]]
        if len(self.skipped) > MOST_LISTED:
            lines.append(f"skipped {len(self.skipped) - MOST_LISTED} more: see {report_files(self.category)[2]}")
        lines += [f"ignored {count} {extension} file(s)" for extension, count in self.ignored_files.items()]
        lines.append("files: " + ", ".join(self.files))
        lines += [f"contact sheet {name}: {LEGEND}" for name in self.files if name.endswith("_contact.png")]
        return "\n".join(lines + [f"warning: {text}" for text in self.warnings])


def report_files(category: str) -> tuple[str, ...]:
    """Names of the files that lie beside the data of every layout."""
    return tuple(f"{synset_of(category)}_{name}" for name in ("card.json", "contact.png", "report.json", "report.txt"))


def write_report(
    config: DatasetConfig,
    folder: Path,
    files: Sequence[str],
    objects: dict[str, int],
    used: list[dict],
    skipped: list[dict],
    ignored: Mapping[str, int],
    sheet: Mapping[str, Sequence[list[np.ndarray]]],
) -> DatasetReport:
    """Write card, report and contact sheet into `folder`, beside the data `files`; `sheet`: its rows by split.

    The card has all that is needed to make the data set again, and the meshes of each split.
    """
    writer, names = WRITERS[config.layout], report_files(config.category)
    warnings = missing_split_warnings(writer, objects)
    written, others = sorted([*files, *names]), dict(sorted(ignored.items()))
    report = DatasetReport(config.category, written, objects, used, skipped, others, warnings)
    card = {
        "layout": config.layout,
        "files": inspect.getdoc(writer),
        "objects_fill": "box centred at the origin, "
        + ("longest side 1" if writer.diagonal is None else f"diagonal {writer.diagonal}"),
        "object_from_mesh": (writer.turn @ conventions.mesh_to_object(config.up, config.facing)).tolist(),
        "settings": settings_of(config),
        "objects": objects,
        "augmented": f"in train, each mesh is followed by its {config.augment} scaled copies",
        "splits": {split: [mesh["name"] for mesh in used if mesh["split"] == split] for split in objects},
    }
    write_json(folder / names[0], card)
    write_png(folder / names[1], draw_sheet(sheet, config.views))
    write_json(folder / names[2], asdict(report))
    (folder / names[3]).write_text(plain(report.text()) + "\n", encoding="utf-8")
    return report


def settings_of(config: DatasetConfig) -> dict:
    """The settings that the files depend on, as plain values."""
    settings = {k: v for k, v in asdict(config).items() if k not in {"output", "overwrite", *HOW}}
    return settings | {"source": None if config.source is None else Path(config.source).name}


def missing_split_warnings(writer: type[Writer], objects: Mapping[str, int]) -> list[str]:
    """Warn of missing splits that the layout has: what cannot be done, and what to do. objects: number by split."""
    usual = {"val": writer.default_val, "test": writer.default_test}
    missing = [split for split, share in usual.items() if share > 0 and not objects.get(split)]
    if not missing:
        return []
    again = "make the set again (--overwrite) from 3 meshes or more, without --val 0 and --test 0"
    if not {"val", "test"} & objects.keys():
        what = "training cannot be validated, nor a model measured, on objects that it has not seen"
        return [f"no {' and no '.join(missing)} split: {what}; {again}"]
    instead = "train with --val-split test" if missing == ["val"] else "evaluate with --split val"
    return [f"no {missing[0]} split: {instead}, or {again}"]
