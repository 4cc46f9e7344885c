#!/usr/bin/env bash
# Makes the model that comes with the package, learn3d/models/small.safetensors: one network for 2,000 generated objects of each of six categories,
# seen from 12 random sides and heights. Its encoder scales every object to one size, because nobody knows how far away the camera of a
# picture stood. A stopped run continues. Usage: bash tools/small_model.sh. Settings: STEPS, OBJECTS, OUT (environment),
# OTHERS (a folder of cut-out pictures of other things, PNG, of which it is to warn; see docs/demo.md).
# An hour and a half on two cores.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
learn3d=${LEARN3D:-.venv/bin/learn3d}
out=${OUT:-output/small-model}
categories=airplane,car,chair,lamp,sofa,table

for category in ${categories//,/ }; do
    "$learn3d" make-dataset --output "$out/data" --layout around --shards --jobs 2 --category "$category" \
        --procedural "${OBJECTS:-2000}" --test 100 --val 60
done
again=$([ -e "$out/run" ] && echo --resume || true)
"$learn3d" train --data "$out/data" --category "$categories" --preset many-views-around \
    --iterations "${STEPS:-48000}" --validate-every 5000 --max-val-images 720 --output "$out/run" $again
"$learn3d" evaluate "$out/run" --data "$out/data" --json "$out/evaluation.json"
mkdir -p learn3d/models
"$learn3d" export --run "$out/run" --output learn3d/models/small.safetensors ${OTHERS:+--others "$OTHERS"}
