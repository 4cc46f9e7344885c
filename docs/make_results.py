"""Fills the tables of docs/results.md, docs/short-trainings.md and docs/methods/plus.md from docs/results/*.json.

python docs/make_results.py            # write the pages
python docs/make_results.py --check    # end with status 1 if a page differs from the files

A file holds tables as rows of cells, the header first: "main", "differences", "runs" with settings and commit of
each run, "angles" with IoUs of silhouettes, and "curves" with its validations, which draw_curves.py draws.
`learn3d experiment TABLE` writes such a file beside its report; copy it here. A block of a page names a file, a part
of it (see `rows`), and further files with the rows of the mean shape and the nearest training object of the same data,
for results that are older than these rows:

<!-- results: kato-cars side baselines-cars -->
"""

import json
import re
import sys
from itertools import groupby, pairwise
from pathlib import Path

DOCS = Path(__file__).parent
PAGES = (DOCS / "results.md", DOCS / "short-trainings.md", DOCS / "methods" / "plus.md")
BLOCK = re.compile(r"(<!-- results: ([\w-]+) (\w+)((?: [\w-]+)*) -->\n)(?:\|.*\n)*")
VOXELS, NO_CLAMP = "here (voxels)", "here (kato18, without clamp)"  # sources of rows in "main"
MEAN_SHAPE = "Mean shape"
#: Methods by the names of their runs, for "measures".
METHODS = {
    "vanilla": "Vanilla-AE",
    "without-adversarial": "w/o adversarial",
    "without-prior": "w/o prior",
    "proposed": "Proposed",
    "plus": "Plus",
    "kar-vanilla": "Vanilla-AE",
    "bins-15x20": "Proposed",
}
_POSES = ("category", "Acc@30", "up to half a turn", "IoU, known poses", "IoU, estimated poses")
_SHOWN = ("voxel IoU", "unclamped IoU", "Chamfer-L1", "F-score", "MMD", "shuffled MMD")


def read(name: str) -> dict[str, list[list[str]]]:
    """The tables of a file by name."""
    return json.loads((DOCS / "results" / f"{name}.json").read_text())


def measures(tables: dict[str, list[list[str]]]) -> list[list[str]]:
    """The measures of each method and category, as means over seeds, and its best validation.

    A second row of a run, its other checkpoint, is left out. "best" is the highest IoU of the
    validations and its step, beside that of the last one.
    """
    header, *runs = tables["runs"]
    kept = [name for name in _SHOWN if name in header]
    validations: dict[str, list[tuple[float, int]]] = {}
    for run, _, step, iou, *_ in tables["curves"][1:]:
        validations.setdefault(run, []).append((float(iou), int(step)))
    groups: dict[tuple[str, str], dict[str, list[str]]] = {}
    for row in runs:
        category, _, folder = row[0].partition("/")
        method, _, _ = folder.rpartition("-seed")
        groups.setdefault((category, METHODS[method]), {}).setdefault(row[0], row)
    lines = [["category", "method", *kept, "validation IoU: last", "best"]]
    for names, by_run in groups.items():
        cells = []
        for measure in kept:
            values = [float(row[header.index(measure)]) for row in by_run.values()]
            cells.append(f"{sum(values) / len(values):.3f}")
        curves = [validations[run] for run in by_run]
        last = sum(curve[-1][0] for curve in curves) / len(curves)
        best = [max(curve) for curve in curves]
        steps = " and ".join(f"{step:,}" for step in sorted({step for _, step in best}))
        best_iou = sum(iou for iou, _ in best) / len(best)
        lines.append([*names, *cells, f"{last:.3f}", f"{best_iou:.3f} after {steps}"])
    return lines


def add_baselines(lines: list[list[str]], part: str, name: str) -> None:
    """Append the row of the mean shape of a file to a table.

    Its difference to the table's baseline has no interval, as the table's objects are not in the file.
    """
    header, *found = read(name)["main"]
    for label, source, *values in found:
        if source != VOXELS or label != MEAN_SHAPE:
            continue
        by_column = dict(zip(header[2:], values, strict=True))
        if part != "side" and header[2:] != lines[0][2:]:
            by_column.pop("mean")  # it is over other categories
        if part == "side":
            value = by_column["mean"]
            ours = next(row[2] for row in lines[1:] if not row[3])
            difference = float(value.split()[0]) - float(ours.split()[0])
            lines.append([label, "-", value, f"{difference:+.3f}", *[""] * (len(lines[0]) - 4)])
        else:
            cells = [by_column.get(column, "-") for column in lines[0][2:]]
            lines.append([label, source, *cells])


def rows(name: str, part: str) -> list[list[str]]:
    """The header and the rows of a table. The second voxelizer stays in the file.

    part: a table of the file, or one made of others: "both" puts the difference under each method,
    "side" puts paper, here and difference of a single category side by side, "seeds" adds the mean difference over
    seeds as a last column, "means" leaves some means over seeds of "poses", "measures" is made by `measures`,
    "baselines" leaves the rows of the mean shape and the others, of this file and of the others side by side.
    """
    tables = read(name)
    if part == "measures":
        return measures(tables)
    if part == "baselines":
        return [[row[0], *row[2:-1]] for row in tables["main"] if row[1] in ("", VOXELS)]
    if part == "seeds":
        header, *main = tables["main"]
        (title, *_, spread), *rest = tables["differences"]
        means = {(row[0], title.split()[0]): row[-1] for row in rest}
        lines = [[*row, means.pop(tuple(row[:2]), "")] for row in main]
        last = [[name, title, *[""] * (len(header) - 2), mean] for (name, _), mean in means.items()]
        return [[*header, f"{title}: {spread}"], *lines, *last]
    if part == "means":
        header, *lines = tables["poses"]
        kept = [k for k, name in enumerate(header) if name in _POSES]
        return [
            [line[k] for k in kept]
            for line in [header, *(line for line in lines if line[1] == "mean")]
        ]
    if part not in ("both", "side"):
        return [row for row in tables[part] if row[1] != "here (kato19)"]
    header, *main = [row for row in tables["main"] if row[1] != "here (kato19)"]
    ours = {name for name, source, *_ in main if source.startswith("here")}
    main = [row for row in main if row[0] in ours]  # quoted methods stay in the file
    baseline = next(
        row[0] for row in main if row[0] not in {row[0] for row in tables["differences"]}
    )
    differences = {row[0]: row[2 - len(header) :] for row in tables["differences"]}
    groups = [list(group) for _, group in groupby(main, key=lambda row: row[0])]
    if part == "both":
        named = [
            [*group, [group[0][0], f"minus {baseline}", *differences.get(group[0][0], [])]]
            for group in groups
        ]
        return [header, *(row for group in named for row in group if len(row) == len(header))]
    unclamped = any(source == NO_CLAMP for _, source, *_ in main)
    lines = [["method", "paper", "here", f"minus {baseline}", *["without clamp"] * unclamped]]
    for group in groups:
        cells = {"paper": "-", "here": "-", NO_CLAMP: ""}
        for _, source, value, mean in group:
            note = " (kato19)" if "kato19" in source else ""
            place = source if source == NO_CLAMP else re.match(r"\w+", source)[0]
            cells[place] = (mean if value == "-" else value) + note
        difference = differences.get(group[0][0], [""])[0]
        last = [cells[NO_CLAMP]] * unclamped
        lines.append([group[0][0], cells["paper"], cells["here"], difference, *last])
    return lines


def plain(cell: str, source: str) -> str:
    """A cell without what the protocol on the page says: the usual measure, and the interval of a value.

    source: the second cell of its row. Intervals of differences stay.
    """
    cell = re.sub(r" \((kato18|mmd|voxels)\b[^)]*\)", "", cell)
    return cell if source.startswith("minus") else re.sub(r"(?<=\d) \[\d[^]]*\]", "", cell)


def table(name: str, part: str, baselines: list[str]) -> str:
    """One table as Markdown. Repeated names in the first column are shown once."""
    lines = rows(name, part)
    for file in baselines:
        if part == "baselines":
            more = [[file.removeprefix("baselines-")], *(row[1:] for row in rows(file, part)[1:])]
            lines = [[*row, *cells] for row, cells in zip(lines, more, strict=True)]
        else:
            add_baselines(lines, part, file)
    lines = [[plain(cell, row[1]) for cell in row] for row in lines]
    header, *body = lines
    firsts = [body[0][0], *("" if a[0] == b[0] else b[0] for a, b in pairwise(body))]
    lines = [header, *([first, *row[1:]] for first, row in zip(firsts, body, strict=True))]
    title, *others = (f"| {' | '.join(line)} |\n" for line in lines)
    return "".join([title, f"|{'---|' * len(header)}\n", *others])


def filled(page: str) -> str:
    """The page with every table made anew."""
    return BLOCK.sub(lambda block: block[1] + table(block[2], block[3], block[4].split()), page)


if __name__ == "__main__":
    for page in PAGES:
        before = page.read_text()
        after = filled(before)
        if "--check" in sys.argv and after != before:
            sys.exit(
                f"{page.name} differs from docs/results/*.json; run python docs/make_results.py"
            )
        page.write_text(after)
