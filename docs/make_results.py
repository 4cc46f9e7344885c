"""Fills the tables of docs/results.md, docs/short-trainings.md and docs/methods/plus.md from docs/results/*.json.

python docs/make_results.py            # write the pages
python docs/make_results.py --check    # end with status 1 if a page differs from the files

A file holds tables as rows of cells, the header first: "main", "differences", "runs" with settings and commit of
each run, and "curves" with its validations, which draw_curves.py draws. `learn3d experiment TABLE` writes such a file
beside its report; copy it here.
"""

import json
import re
import sys
from itertools import groupby, pairwise
from pathlib import Path

DOCS = Path(__file__).parent
PAGES = (DOCS / "results.md", DOCS / "short-trainings.md", DOCS / "methods" / "plus.md")
BLOCK = re.compile(r"(<!-- results: ([\w-]+) (\w+) -->\n)(?:\|.*\n)*")


def rows(name: str, part: str) -> list[list[str]]:
    """The header and the rows of a table. The second voxelizer stays in the file.

    part: a table of the file, or one made of "main" and "differences": "both" puts the difference under each method,
    "side" puts paper, here and difference of a single category side by side, "seeds" adds the mean difference over
    seeds as a last column, "means" leaves the means over seeds of "poses".
    """
    tables = json.loads((DOCS / "results" / f"{name}.json").read_text())
    if part == "seeds":
        header, *main = tables["main"]
        (title, *_, spread), *rest = tables["differences"]
        means = {(row[0], title.split()[0]): row[-1] for row in rest}
        lines = [[*row, means.pop(tuple(row[:2]), "")] for row in main]
        last = [[name, title, *[""] * (len(header) - 2), mean] for (name, _), mean in means.items()]
        return [[*header, f"{title}: {spread}"], *lines, *last]
    if part == "means":
        header, *lines = tables["poses"]
        kept = [k for k, name in enumerate(header) if name != "seed"]
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
    lines = [["method", "paper", "here", f"minus {baseline}"]]
    for group in groups:
        cells = {"paper": "-", "here": "-"}
        for _, source, value, mean in group:
            note = " (kato19)" if "kato19" in source else ""
            cells[re.match(r"\w+", source)[0]] = (mean if value == "-" else value) + note
        lines.append(
            [group[0][0], cells["paper"], cells["here"], differences.get(group[0][0], [""])[0]]
        )
    return lines


def table(name: str, part: str) -> str:
    """One table as Markdown. Repeated names in the first column are shown once."""
    header, *body = rows(name, part)
    firsts = [body[0][0], *("" if a[0] == b[0] else b[0] for a, b in pairwise(body))]
    lines = [header, *([first, *row[1:]] for first, row in zip(firsts, body, strict=True))]
    title, *others = (f"| {' | '.join(line)} |\n" for line in lines)
    return "".join([title, f"|{'---|' * len(header)}\n", *others])


def filled(page: str) -> str:
    """The page with every table made anew."""
    return BLOCK.sub(lambda block: block[1] + table(block[2], block[3]), page)


if __name__ == "__main__":
    for page in PAGES:
        before = page.read_text()
        after = filled(before)
        if "--check" in sys.argv and after != before:
            sys.exit(
                f"{page.name} differs from docs/results/*.json; run python docs/make_results.py"
            )
        page.write_text(after)
