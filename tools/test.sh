#!/usr/bin/env bash
# Installs the package with everything its tests need into .venv and runs the tests, a process per core (JOBS: that many; 0: in
# this one). Arguments go to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. tools/setup.sh

setup test
step "Style"
.venv/bin/ruff check .
.venv/bin/ruff format --check .
step "Tests"
check_room "${TMPDIR:-/tmp}" 5 ", or set TMPDIR to a folder on another disk" # checkpoints of the paper's networks
# The script pytest, not python -m pytest: the latter would import the source folder in place of the installed package.
# One thread for each process, as threads that wait for each other on shared cores take many times as long. Files stay together:
# their tests share trained runs and compiled programs; and in the order of their names, as the longest have the fewest tests and
# would come last otherwise.
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
exec .venv/bin/pytest -n "${JOBS:-auto}" --maxprocesses 8 --dist loadfile --no-loadscope-reorder --cov --cov-report=term:skip-covered "$@"
