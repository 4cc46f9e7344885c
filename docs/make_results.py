"""Fills the tables of docs/results.md from docs/results/*.json.

python docs/make_results.py            # write the page
python docs/make_results.py --check    # end with status 1 if the page differs from the files

A file holds tables as rows of cells, the header first: "main", "differences", and "runs" with settings and commit of
each run. `learn3d experiment TABLE` writes such a file beside its report; copy it here.
"""

import json
import re
import sys
from itertools import pairwise
from pathlib import Path

DOCS = Path(__file__).parent
PAGE = DOCS / "results.md"
BLOCK = re.compile(r"(<!-- results: ([\w-]+) (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def table(name: str, part: str) -> str:
    """One table of a file as Markdown. Repeated names are shown once; the second voxelizer stays in the file."""
    header, *rows = json.loads((DOCS / "results" / f"{name}.json").read_text())[part]
    rows = [row for row in rows if row[1] != "here (kato19)"]
    firsts = [rows[0][0], *("" if a[0] == b[0] else b[0] for a, b in pairwise(rows))]
    lines = [header, ["---"] * len(header), *([first, *row[1:]] for first, row in zip(firsts, rows, strict=True))]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def filled(page: str) -> str:
    """The page with every table made anew."""
    return BLOCK.sub(lambda block: block[1] + table(block[2], block[3]) + block[4], page)


if __name__ == "__main__":
    before = PAGE.read_text()
    after = filled(before)
    if "--check" in sys.argv and after != before:
        sys.exit("docs/results.md differs from docs/results/*.json; run python docs/make_results.py")
    PAGE.write_text(after)
