"""No picture of README and docs is older than the files that `make_pictures` names as its sources."""

import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
_spec = importlib.util.spec_from_file_location("make_pictures", ROOT / "docs" / "make_pictures.py")
make_pictures = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(make_pictures)


def test_every_picture_has_a_command_and_a_record() -> None:
    pictures = {path.name for path in make_pictures.IMAGES.iterdir() if path.suffix != ".json"}
    assert pictures == set(make_pictures.PICTURES) == set(make_pictures.records())


def test_every_picture_is_shown() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    shown = {name for page in pages for name in re.findall(r"images/([\w-]+\.\w+)\)", page.read_text())}
    assert shown == set(make_pictures.PICTURES)


def test_no_picture_is_older_than_the_code_that_draws_it() -> None:
    old = make_pictures.out_of_date()
    assert not old, f"draw them again: python docs/make_pictures.py {' '.join(old)}"


def test_a_changed_source_is_noticed(monkeypatch, tmp_path) -> None:
    source = tmp_path / "draw.py"
    source.write_text("1")
    picture = make_pictures.Picture("", "", (str(source),))
    monkeypatch.setattr(make_pictures, "PICTURES", {"a.png": picture})
    made = {"a.png": {"sources": make_pictures.digest(picture)}}
    monkeypatch.setattr(make_pictures, "records", lambda: made)
    assert make_pictures.out_of_date() == []
    source.write_text("2")
    assert make_pictures.out_of_date() == ["a.png"]
