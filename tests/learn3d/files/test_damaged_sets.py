"""Damaged data sets: they are read, or an error names the damaged file."""

from __future__ import annotations

import contextlib
import random
import shutil
import signal
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzz_targets import ERRORS, FILES, SETTINGS, TARGETS, Target, layout_target
from reader_checks import at_most

from learn3d.data.conventions import LAYOUTS
from learn3d.data.layouts import check_folder
from learn3d.presets import configure
from learn3d.training import train

DAMAGED = {  # what is cut short, and a preset of the layout
    "kato": ("03001627_train_images.npz", "peng2020-kato-vanilla"),
    "dvr": ("03001627/*/image/0000.png", "peng2020-kato-vanilla"),
    "kar": ("renders/03001627/*/render_0.png", "peng2020-kar-vanilla"),
    "pascal3d": ("chair_train.npz", "peng2020-pascal-vanilla"),
    "photos": ("chair/images/*.png", "peng2020-kato-vanilla"),
}


def test_every_layout_is_tried():
    message = (
        "add the layout to DAMAGED here, and to FILES (and SETTINGS) of tests/data/fuzz_targets.py"
    )
    assert set(DAMAGED) == set(FILES) == {*SETTINGS, "dvr"} == set(LAYOUTS) - {"around"}, message


@pytest.mark.parametrize("layout", DAMAGED)
def test_a_damaged_file_ends_training_with_its_name_and_what_to_do(tmp_path: Path, layout: str):
    (tmp_path / "made").mkdir()
    folder = shutil.copytree(layout_target(tmp_path / "made", layout).folder, tmp_path / "data set")
    pattern, preset = DAMAGED[layout]
    for path in folder.glob(pattern):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    where = {"data": folder, "category": "chair", "output": tmp_path / "run"}
    config = configure(
        **where, preset=preset, layout=layout, iterations=1, batch_size=2, val_split="test"
    )
    with pytest.raises(ValueError) as error:
        train(config)
    named, text = Path(str(error.value).split(": ", 1)[0]), str(error.value)
    assert named.is_file() and named.match(pattern)
    assert text.endswith(
        f"faults of the data set, run: learn3d check-dataset '{folder}' --layout {layout}"
    )
    assert text.count("cut short") == text.count("fetch it again") == 1
    assert not {path.name for path in (tmp_path / "run").glob("*")} - {".lock"}
    found = check_folder(layout, folder, ["chair"])
    assert str(named) in {problem.path for split in found for problem in split.problems}


SECONDS = 20  # an example that takes longer is a hang
MEMORY = 400 * 2**20  # bytes that Python and NumPy may hold at a time


class Hang(BaseException):
    """No Exception, so that no reader takes it for one of its own."""


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Fail if the block takes too long or too much memory."""

    def stop(number: int, frame: object) -> None:
        raise Hang(f"still reading after {SECONDS} seconds")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        with at_most(MEMORY):
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def attack(target: Target, seed: int) -> None:
    """Damage one file, read, and put all files back."""
    rng = random.Random(seed)
    name = rng.choice(sorted(target.damaged))
    sound = {each: (target.folder / each).read_bytes() for each in target.damaged}
    try:
        with warnings.catch_warnings():
            # of Pillow and NumPy about odd values, of zipfile about doubled names
            warnings.simplefilter("ignore")
            (target.folder / name).write_bytes(target.damaged[name](rng, sound[name]))
            with bounded():
                target.read(target.folder)
    except ERRORS as error:
        assert str(error).strip(), "an error must say something"
    except BaseException as error:
        error.add_note(f"seed {seed}, {name} damaged") if hasattr(error, "add_note") else None
        raise
    finally:
        for each, content in sound.items():
            (target.folder / each).write_bytes(content)


@pytest.mark.parametrize("kind", TARGETS)
def test_damaged_files_are_read_or_refused(
    kind: str, tmp_path, request: pytest.FixtureRequest
) -> None:
    target = TARGETS[kind](tmp_path)
    target.read(target.folder)  # sound files are read
    examples = request.config.getoption("--fuzz-examples")
    start = random.randrange(2**48) if examples else 0
    for seed in range(start, start + (examples or 10)):
        attack(target, seed)
