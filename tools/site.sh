#!/usr/bin/env bash
# Builds the documentation site: site/index.html. Warnings are errors. Arguments go to sphinx-build.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. tools/setup.sh

setup site
step "Site"
.venv/bin/sphinx-build --fail-on-warning --keep-going --quiet -d build/doctrees "$@" docs site
echo "site/index.html"
