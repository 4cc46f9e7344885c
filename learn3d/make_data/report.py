"""What was made: the report of `learn3d.make_data.render.make_dataset`, for people and as plain values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from learn3d.make_data.contact_sheet import LEGEND
from learn3d.make_data.writers import Writer


@dataclass(frozen=True)
class DatasetReport:
    """What `make_dataset` did."""

    category: str
    files: list[str]  # files and folders written, relative to the output folder
    objects: dict[str, int]  # objects per split, augmented copies included
    used: list[dict]  # per mesh: name, split, vertices, faces, watertight
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
        lines += [f"skipped {mesh['name']} ({mesh['split']}): {mesh['reason']}" for mesh in self.skipped]
        lines += [f"ignored {count} {extension} file(s)" for extension, count in self.ignored_files.items()]
        lines.append("files: " + ", ".join(self.files))
        lines += [f"contact sheet {name}: {LEGEND}" for name in self.files if name.endswith("_contact.png")]
        return "\n".join(lines + [f"warning: {text}" for text in self.warnings])


def lacking(writer: Writer | type[Writer], objects: dict[str, int]) -> list[str]:
    """What cannot be done for want of a split that the layout has, and what to do. objects: their numbers by split."""
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
