"""How commands end, and the lines that they print."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from children import environment, wait_until

from learn3d import terminal
from learn3d.terminal import align, progress, say, without_traceback

INTERRUPTED = "interrupted; what was saved before is as it was\n"
PROGRAM = """
import sys
from learn3d.terminal import without_traceback, {call}

@without_traceback
def main():
    for _ in range(10):
        {call}("a line of a table")
    return 0

sys.exit(main())
"""


def test_an_interrupted_data_set_leaves_nothing(tmp_path) -> None:
    command = [sys.executable, "-m", "learn3d", "make-dataset", "--output", str(tmp_path / "data")]
    command += ["--category", "chair", "--procedural", "500"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        begun = "data/.make_dataset_*/new"
        wait_until(lambda: list(tmp_path.glob(begun)) or process.poll() is not None, 120)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)
    assert (process.returncode, out) == (130, "")
    assert err.endswith(INTERRUPTED) and "Traceback" not in err
    assert list((tmp_path / "data").iterdir()) == []


@pytest.mark.parametrize(
    "error", [ValueError("a"), FileNotFoundError("b"), FloatingPointError("c"), TypeError("d")]
)
def test_errors_are_a_line_and_mistakes_of_ours_are_not_hidden(error: Exception, capsys) -> None:
    @without_traceback
    def main() -> int:
        raise error

    if isinstance(error, TypeError):
        with pytest.raises(TypeError):
            main()
    else:
        assert main() == 1
        assert capsys.readouterr().err == f"error: {error}\n"


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("std::bad_alloc"),
        RuntimeError("can't start new thread"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate\n7 bytes."),
        torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"),
    ],
    ids=range(5),
)
def test_too_little_memory_is_a_line_whoever_notices_it(error: Exception, capsys) -> None:
    @without_traceback
    def main(error: Exception) -> int:
        raise error

    assert main(error) == 1
    assert re.fullmatch(
        r"error: there is too little memory; end other programs, or give .* \(.+\)\n",
        capsys.readouterr().err,
    )
    with pytest.raises(RuntimeError, match="shape"):
        main(RuntimeError("a shape is wrong"))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk that is always full")
@pytest.mark.parametrize(
    ("call", "stream", "status"), [("say", "stdout", 1), ("note", "stderr", 0)]
)
def test_a_lost_result_is_an_error_and_lost_progress_is_none(
    call: str, stream: str, status: int
) -> None:
    with open("/dev/full", "w") as full:
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | {stream: full}
        result = subprocess.run(
            [sys.executable, "-c", PROGRAM.format(call=call)], **streams, timeout=120
        )
    assert result.returncode == status
    assert call == "note" or result.stderr == b"error: [Errno 28] No space left on device\n"


@pytest.mark.parametrize(
    "program", [["-c", PROGRAM.format(call="say")], ["-m", "learn3d", "train", "--help"]]
)
def test_an_output_that_nobody_reads_is_no_error(program: list[str], tmp_path) -> None:
    """As with `| head`."""
    reading, writing = os.pipe()
    os.close(reading)
    result = subprocess.run(
        [sys.executable, *program],
        stdout=writing,
        stderr=subprocess.PIPE,
        timeout=120,
        cwd=tmp_path,
    )
    os.close(writing)
    assert (result.returncode, result.stderr) == (0, b"")


def test_progress_is_a_line_now_and_then_where_no_terminal_is(capsys, monkeypatch) -> None:
    monkeypatch.setattr(terminal, "SECONDS_BETWEEN_LINES", 0.05)
    items = range(100, 104)
    read = [item for item in progress(items, "a\x1bb", unit="mesh") if not time.sleep(0.06)]
    assert read == list(items)
    shown = capsys.readouterr().err
    assert shown.splitlines() == [
        line for line in shown.splitlines() if line.startswith("a\\x1bb: ")
    ]
    assert "2 of 4, 00:00 left\n" in shown and "\r" not in shown
    assert list(progress(items, None, unit="mesh")) == read and capsys.readouterr().err == ""
    monkeypatch.setattr(terminal, "is_watched", lambda: True)
    assert list(progress(items, "a\x1bb", unit="mesh")) == read
    assert capsys.readouterr().err.startswith("\ra\\x1bb: ")


def test_a_closed_stderr_puts_nothing_among_the_results(capsys, monkeypatch) -> None:
    monkeypatch.setattr("sys.stderr", None)
    terminal.note("a line of progress")
    monkeypatch.undo()
    assert capsys.readouterr() == ("", "")


def test_columns_are_as_wide_as_their_widest_cell() -> None:
    assert align([("a", "b", "c"), ("longer", "", "x"), ("", "long", "")]) == (
        "a       b     c\nlonger        x\n        long"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="names that are no text")
def test_names_of_strangers_give_a_terminal_no_commands(tmp_path, capsys, command) -> None:
    title, turned, broken = "\x1b]0;title\x07", "\u202etxt.exe", os.fsdecode(b"\xff")
    say(f"a\tb\n{title} \x9b31m {turned} {broken} Ångström 椅子")
    assert (
        capsys.readouterr().out
        == "a\tb\n\\x1b]0;title\\x07 \\x9b31m \\u202etxt.exe \\udcff Ångström 椅子\n"
    )
    for name in "abc":
        (tmp_path / f"{name}.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 1\n3 0 1 2\n")
    (tmp_path / os.fsdecode(b"\xff\x1b[2J.off")).write_text("no mesh")
    words = f"make-dataset --output {tmp_path}/data --category chair --source {tmp_path} --test 0 --val 0"
    status, out, _ = command(*words.split())
    assert status == 0 and "skipped \\udcff\\x1b[2J.off (train): " in out


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs terminals as of Unix")
def test_ctrl_c_is_answered_on_a_terminal() -> None:
    master, slave = os.openpty()
    script = "import os, signal; from learn3d.terminal import stop_on_signal\n"
    script += "with stop_on_signal() as stop: os.kill(os.getpid(), signal.SIGINT); print(stop.name)"
    ended = subprocess.run(
        [sys.executable, "-c", script], stderr=slave, stdout=subprocess.PIPE, env=environment()
    )
    os.close(slave)
    said = os.read(master, 1000)
    os.close(master)
    assert ended.stdout.split() == [b"SIGINT"] and b"a second Ctrl-C ends at once" in said
