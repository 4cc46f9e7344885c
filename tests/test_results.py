"""The tables of docs/results.md are those of docs/results/*.json, and so are the results in the README."""

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_page_has_the_tables_of_the_files():
    command = [sys.executable, ROOT / "docs" / "make_results.py", "--check"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_results_in_the_readme_are_in_the_files():
    cells = [path.read_text() for path in (ROOT / "docs" / "results").glob("*.json")]
    assert all(json.loads(text)["main"] for text in cells)
    readme = (ROOT / "README.md").read_text()
    section = readme[readme.index("## 3. ") : readme.index("## Documentation")]
    figures = re.findall(r"\b0\.\d{3}\b", section)
    assert len(figures) >= 11 and not [figure for figure in figures if not any(figure in text for text in cells)]
