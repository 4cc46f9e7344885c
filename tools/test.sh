#!/usr/bin/env bash
# Installs the package with everything its tests need into .venv and runs the tests. Arguments go to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. tools/setup.sh

setup test
step "Style"
.venv/bin/ruff check .
.venv/bin/ruff format --check .
step "Tests"
# The script pytest, not python -m pytest: the latter would import the source folder in place of the installed package.
exec .venv/bin/pytest --cov --cov-report=term:skip-covered "$@"
