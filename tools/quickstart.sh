#!/usr/bin/env bash
# From a fresh clone to reconstructed meshes: installs, makes data, trains two models for a few minutes, measures them, reconstructs.
# Usage: bash tools/quickstart.sh [CATEGORY] (airplane, chair, ...; default airplane). Settings: STEPS, OBJECTS, OUT (environment).
set -euo pipefail
here=$PWD
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. tools/setup.sh

category=${1:-airplane}
steps=${STEPS:-800}
objects=${OBJECTS:-250}
out=$PWD/quickstart
[ -z "${OUT:-}" ] || case $OUT in /*) out=$OUT ;; *) out=$here/$OUT ;; esac
trap 'echo; echo "stopped; what is finished is in $out"; exit 130' INT

setup train
mkdir -p "$out" || fail "cannot make the folder $out"

step "Making $objects ${category}s, each rendered from 24 views"
"$python" tools/make_dataset.py --output "$out/data" --category "$category" --procedural "$objects" --overwrite

for method in proposed vanilla; do
    step "Training the method '$method' for $steps steps"
    "$python" tools/train.py --data "$out/data" --category "$category" --preset "$method" --output "$out/$method" \
        --overwrite --iterations "$steps" --validate-every 200 --pictures-every 200 --checkpoint-every 200
done

step "Measuring both on the test objects, which neither has seen"
"$python" tools/evaluate.py "$out/proposed" "$out/vanilla" --data "$out/data" --json "$out/evaluation.json"

step "Reconstructing four test images"
"$python" tools/reconstruct.py --run "$out/proposed" --data "$out/data" --indices 31 85 58 15 --output "$out/meshes"

cat <<TEXT

Look at:
  the data           $(ls "$out"/data/*_contact.png)
  while it learned   $out/proposed/pictures/   (rows: input, target, rendering, new views; beside it $out/vanilla/pictures/)
  reconstructions    $out/meshes/              (a mesh, a turntable GIF and a strip of views for each image)
  the figures        $out/evaluation.json
TEXT
