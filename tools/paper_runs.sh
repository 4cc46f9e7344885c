#!/usr/bin/env bash
# Trains what docs/results.md could not yet judge: the paper's methods at the paper's length, on 2,000 generated
# objects of a category, in the order in which the answers matter. It takes some 37 hours of a core with AMX.
#
#   bash tools/paper_runs.sh WORK --jobs 2 --threads 1       # data sets, runs and reports go into the folder WORK
#   STEPS=5000 bash tools/paper_runs.sh WORK --jobs 2 --threads 1              # shorter, for a slow machine
#   STEPS=5000 SEEDS=3 bash tools/paper_runs.sh WORK --jobs 16 --threads 1 --device cuda          # seeds on a GPU
#   bash tools/paper_runs.sh WORK --report-only              # only the reports of what is done
#
# Options after WORK are those of `learn3d experiment`. Stopped or killed, the same command goes on. A folder
# WORK/<steps> has the runs of that length; copy its reports (*.json) to docs/results.
set -euo pipefail

work=${1:?"give a folder for data sets and runs"}
shift
options=("$@")
steps=${STEPS:-20000} # the paper's length, in steps of 128 images
seeds=${SEEDS:-1}

dataset() { # LAYOUT CATEGORY: makes it, unless it is complete
    if ! compgen -G "$work/$1-$2/*_card.json" > /dev/null; then
        learn3d make-dataset --layout "$1" --output "$work/$1-$2" --category "$2" --procedural 2000
    fi
}

experiment() { # TABLE LAYOUT CATEGORY STEPS SEEDS SETTING METHOD...
    dataset "$2" "$3"
    learn3d experiment "$1" --data "$work/$2-$3" --output "$work/$4" --category "$3" --iterations "$4" --seeds "$5" \
        --methods "${@:7}" --set clamp_to_cube=true validate_every=1000 $6 "${options[@]}"
    mkdir -p "$work/reports"
    cp "$work/$4/$1.json" "$work/reports/$1-$3-$4.json" # the next category writes the same file
}

# Tables 1 and 6 on airplanes, then table 4: the prior alone, the adversarial loss alone
experiment kato kato airplane "$steps" "$seeds" "" Vanilla-AE Proposed
experiment ablation kato airplane "$steps" "$seeds" "" Proposed "w/o adversarial"
experiment ablation kato airplane "$steps" "$seeds" "" Proposed "w/o adversarial" "w/o prior"
experiment mmd kato airplane "$steps" "$seeds" "" Vanilla-AE Proposed
for category in chair car; do
    experiment kato kato $category "$steps" "$seeds" "" Vanilla-AE Proposed
    experiment ablation kato $category "$steps" "$seeds" "" Proposed "w/o adversarial" "w/o prior"
    experiment mmd kato $category "$steps" "$seeds" "" Vanilla-AE Proposed
done

# Three seeds at half of the length
half=$((steps / 2))
experiment kato kato airplane $half 3 "" Vanilla-AE Proposed
experiment ablation kato airplane $half 3 "" Proposed "w/o adversarial"
experiment mmd kato airplane $half 3 "" Vanilla-AE Proposed

# Table 3: one view of each object, as published; table 1: VPL with a weight that trains; Plus
quarter=$((steps / 4))
experiment kar kar airplane $quarter 1 "" Vanilla-AE Proposed
experiment kato kato airplane $quarter 1 vpl:lambda_discriminator=0.1 VPL
for category in airplane chair; do
    experiment plus kato $category "$steps" 1 "" Proposed Plus
done
