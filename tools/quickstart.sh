#!/usr/bin/env bash
# From a fresh clone to reconstructed meshes: installs, makes data, trains two models for a few minutes, measures them, reconstructs.
# Usage: bash tools/quickstart.sh [CATEGORY] (airplane, chair, ...; default airplane). Settings: STEPS, OBJECTS, OUT (environment).
set -euo pipefail
out=$(realpath -m "${OUT:-$(dirname "${BASH_SOURCE[0]}")/../quickstart}")
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. tools/setup.sh

category=${1:-airplane}
steps=${STEPS:-1600} # steps of 32 images; Vanilla-AE takes a quarter of the steps, of 128 images, as published
objects=${OBJECTS:-250}
learn3d=$PWD/.venv/bin/learn3d

setup report

step "Turning six pictures into meshes in colour, with the model that comes with the package"
.venv/bin/python docs/examples/draw_small_model.py --output "$out/pictures"

step "Making $objects ${category}s, each rendered from 24 views"
"$learn3d" make-dataset --output "$out/data" --category "$category" --procedural "$objects" --overwrite

train() { # method, steps
    step "Training the method '$1' for $2 steps"
    "$learn3d" train --data "$out/data" --category "$category" --preset "$1" --output "$out/$1" \
        --overwrite --iterations "$2" --validate-every $(($2 / 4)) --pictures-every $(($2 / 4)) --checkpoint-every $(($2 / 4))
}
train plus "$steps"
train vanilla $((steps / 4))

step "Measuring both on the test objects, which neither has seen"
"$learn3d" evaluate "$out/plus" "$out/vanilla" --data "$out/data" --json "$out/evaluation.json"

step "Reconstructing four test images"
"$learn3d" reconstruct --run "$out/plus" --data "$out/data" --indices 31 85 58 15 --output "$out/meshes"

step "Writing the report"
"$learn3d" report "$out/plus" "$out/vanilla" --data "$out/data" --output "$out/report.html"

cat <<TEXT

Look at:
  $out/pictures/small-model.png    pictures, and the meshes in colour made of them (beside it .glb files)
  $out/report.html    in a browser: both methods on test objects, with meshes to turn by hand
  $out/plus/pictures    while it learned: input, target, rendering, new views
  $out/meshes    a mesh, a turntable GIF and a strip of views for each of the four images
TEXT
