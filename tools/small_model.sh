#!/usr/bin/env bash
# Makes the model that comes with the package, learn3d/studio/picture_to_mesh/small.safetensors: one network for six categories. It learns from
# 2,000 generated objects of each, and from the models of Debian's furniture packages that are in the public domain or under
# CC BY, 12 stretched forms of each; 12 random views per form. Its encoder scales every object to one size, because nobody
# knows how far away the camera of a picture was. The first 1,000 generated objects of each category become templates. A stopped
# run continues. Icons teach it at last which kind a drawing shows (learn_kinds.py, which needs npm and resvg_py).
# Environment: STEPS, OBJECTS, OUT, BIN.
# Usage: bash tools/small_model.sh. The training takes an hour and a half on two cores.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bin=${BIN:-.venv/bin}
out=${OUT:-output/small-model}
categories=airplane,car,chair,lamp,sofa,table

[ -e "$out/models" ] || "$bin/python" tools/free_meshes/fetch.py --output "$out/models"
"$bin/python" - "$out" <<'EOF'
import csv, pathlib, shutil, sys
out = pathlib.Path(sys.argv[1])
for row in csv.DictReader(open(out / "models/index.csv", newline="")):
    is_free = "Public domain" in row["licence"] or "Creative Commons Attribution" in row["licence"]
    target = out / ("free" if is_free else "others") / row["file"]
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(out / "models" / row["file"], target)
EOF
for category in ${categories//,/ }; do
    models=$out/free/$category
    "$bin/learn3d" make-dataset --output "$out/data" --layout around --shards --jobs 2 --category "$category" \
        --procedural "${OBJECTS:-2000}" $([ ! -d "$models" ] || echo --source "$models" --augment 11) --test 100 --val 60
done
again=$([ -e "$out/run" ] && echo --resume || true)
"$bin/learn3d" train --data "$out/data" --category "$categories" --preset many-views-around \
    --iterations "${STEPS:-36000}" --validate-every 5000 --max-val-images 720 --output "$out/run" $again
"$bin/learn3d" evaluate "$out/run" --data "$out/data" --json "$out/evaluation.json"
"$bin/learn3d" export --run "$out/run" --output learn3d/studio/picture_to_mesh/small.safetensors
"$bin/python" tools/learn_kinds.py
