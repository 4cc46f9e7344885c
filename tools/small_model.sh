#!/usr/bin/env bash
# Makes the small model that comes with the package, learn3d/models/small.safetensors: one network for 250 generated objects of each of six
# categories, seen from random sides and heights. Its encoder scales every object to one size, because nobody knows how far away the camera of a
# picture stood. Usage: bash tools/small_model.sh. Settings: STEPS, OBJECTS, OUT (environment). Half an hour on two cores.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
learn3d=${LEARN3D:-.venv/bin/learn3d}
out=${OUT:-output/small-model}
categories=airplane,car,chair,lamp,sofa,table

for category in ${categories//,/ }; do
    "$learn3d" make-dataset --output "$out/data" --layout kar --views 12 --category "$category" \
        --procedural "${OBJECTS:-250}" --overwrite
done
"$learn3d" train --data "$out/data" --layout kar --views-per-object 12 --category "$categories" --preset plus \
    --encoder conv-centred --generator sphere-small --bank-size 6144 --iterations "${STEPS:-24000}" --validate-every 6000 \
    --output "$out/run" --overwrite
"$learn3d" evaluate "$out/run" --data "$out/data" --json "$out/evaluation.json"
mkdir -p learn3d/models
"$learn3d" export --run "$out/run" --output learn3d/models/small.safetensors
