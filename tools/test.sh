#!/usr/bin/env bash
# Installs the package with everything its tests need into .venv and runs the tests.
# Usage: bash tools/test.sh [--all] [PYTEST ARGUMENTS]
#   --all   the slow tests as well: trainings of minutes, sanitizers, long kills (what CI runs)
# Add --cov for the coverage of the Python code, which takes longer.
# JOBS: number of test processes (default: one per core, at most 8; 0: pytest's own process, for --pdb).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. tools/setup.sh

which=(-m "not slow") room=2
if [ "${1:-}" = --all ]; then
    shift
    which=(--durations=60) room=5
fi
setup test
step "Style"
.venv/bin/ruff check .
.venv/bin/ruff format --check .
.venv/bin/clang-format --dry-run --Werror csrc/*.{cpp,h} csrc/bindings/* tests/csrc/*.{cpp,h}
step "Tests"
check_room "${TMPDIR:-/tmp}" $room
# The script pytest, not python -m pytest, which would import the source folder in place of the installed package.
# One thread per process: threads that wait for each other on shared cores take many times as long. The tests of a file
# stay together, as they share trained runs and compiled programs. Files go in the order of their names.
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
# A test that hangs ends its process with the stacks of all threads, and counts as failed.
limit=(-o faulthandler_timeout=1200 -o faulthandler_exit_on_timeout=true)
exec .venv/bin/pytest -n "${JOBS:-auto}" --maxprocesses 8 --dist loadfile --no-loadscope-reorder "${limit[@]}" "${which[@]}" "$@"
