"""The README's code runs, and its commands name files that exist."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_the_python_example_runs_and_fits_the_target():
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names = {}
    exec(code, names)
    assert names["images"].shape == (2, 64, 64)
    assert names["nmr"].losses.soft_iou_loss(names["images"], names["target"]) < 0.1


def test_what_it_names_exists():
    named = set(re.findall(r"(?:tools|docs|csrc|nmr|learn3d)/[\w./-]*\w\.(?:py|sh|md|png|cpp)", README))
    assert len(named) > 5
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []
