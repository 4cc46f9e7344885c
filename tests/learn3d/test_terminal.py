"""How the tools end: errors and Ctrl-C are a line; columns of text."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from learn3d.commands import main
from learn3d.terminal import align, say, without_traceback

INTERRUPTED = "interrupted; what was saved before is as it was\n"


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT to another process")
def test_an_interrupted_data_set_leaves_nothing(tmp_path) -> None:
    command = [sys.executable, "-m", "learn3d", "make-dataset", "--output", str(tmp_path / "data")]
    command += ["--category", "chair", "--procedural", "500"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        while not list(tmp_path.glob("data/.make_dataset_*/new")) and time.monotonic() < deadline:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert (process.returncode, out) == (130, "")
    assert err.endswith(INTERRUPTED) and "Traceback" not in err
    assert list((tmp_path / "data").iterdir()) == []


def test_errors_are_a_line_and_mistakes_of_ours_are_not_hidden(capsys) -> None:
    @without_traceback(FloatingPointError)
    def main(error: Exception | None) -> int:
        if error:
            raise error
        return 7

    assert main(None) == 7
    for error in (ValueError("a"), FileNotFoundError("b"), FloatingPointError("c")):
        assert main(error) == 1
        assert capsys.readouterr().err == f"error: {error}\n"
    with pytest.raises(TypeError):
        main(TypeError("d"))


def test_an_output_that_was_never_open_is_no_error(monkeypatch) -> None:
    """As with `>&-` in a shell: Python has no stdout then."""
    monkeypatch.setattr(sys, "stdout", None)
    assert without_traceback()(lambda: say("nobody reads this") or 0)() == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk that is always full")
@pytest.mark.parametrize(("call", "status"), [("say", 1), ("note", 0)])
def test_a_result_that_cannot_be_written_is_an_error_and_lost_progress_is_none(call: str, status: int) -> None:
    program = f"""
import sys
from learn3d.terminal import without_traceback, {call}

@without_traceback()
def main():
    {call}("a table")
    return 0

sys.exit(main())
"""
    stream = {"say": "stdout", "note": "stderr"}[call]
    with open("/dev/full", "w") as full:
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | {stream: full}
        result = subprocess.run([sys.executable, "-c", program], **streams, timeout=120)
    assert result.returncode == status
    assert call == "note" or result.stderr == b"error: [Errno 28] No space left on device\n"


@pytest.mark.skipif(os.name != "posix", reason="a pipe without a reader ends otherwise there")
def test_an_output_that_nobody_reads_is_no_error() -> None:
    """As with `| head`."""
    program = """
import sys
from learn3d.terminal import without_traceback, say

@without_traceback()
def main():
    for _ in range(10):
        say("a line of a table")
    return 0

sys.exit(main())
"""
    reading, writing = os.pipe()
    os.close(reading)
    result = subprocess.run([sys.executable, "-c", program], stdout=writing, stderr=subprocess.PIPE, timeout=120)
    os.close(writing)
    assert (result.returncode, result.stderr) == (0, b"")


def test_a_pipe_that_breaks_elsewhere_is_an_error(capsys) -> None:
    @without_traceback()
    def main() -> int:
        raise BrokenPipeError("of a worker")

    assert main() == 1
    assert capsys.readouterr().err == "error: of a worker\n"


def test_columns_are_as_wide_as_their_widest_cell() -> None:
    assert align([("a", "b", "c"), ("longer", "", "x"), ("", "long", "")]) == (
        "a       b     c\nlonger        x\n        long"
    )


def test_names_of_strangers_give_a_terminal_no_commands(capsys) -> None:
    title, turned, broken = "\x1b]0;title\x07", "\u202etxt.exe", os.fsdecode(b"\xff")
    say(f"a\tb\n{title} \x9b31m {turned} {broken} Ångström 椅子")
    assert capsys.readouterr().out == "a\tb\n\\x1b]0;title\\x07 \\x9b31m \\u202etxt.exe \\udcff Ångström 椅子\n"


@pytest.mark.skipif(sys.platform != "linux", reason="names that are no text")
def test_a_mesh_whose_name_is_no_text_is_listed(tmp_path, monkeypatch, capsys) -> None:
    for name in "abc":
        (tmp_path / f"{name}.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 1\n3 0 1 2\n")
    (tmp_path / os.fsdecode(b"\xff\x1b[2J.off")).write_text("no mesh")
    command = [
        "learn3d",
        "make-dataset",
        "--output",
        str(tmp_path / "data"),
        "--category",
        "chair",
        "--source",
        str(tmp_path),
    ]
    monkeypatch.setattr(sys, "argv", [*command, "--test", "0", "--val", "0"])
    assert main() == 0
    for text in (capsys.readouterr().out, (tmp_path / "data" / "03001627_report.txt").read_text()):
        assert "skipped \\udcff\\x1b[2J.off (train): " in text
