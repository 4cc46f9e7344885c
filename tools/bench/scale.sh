#!/bin/bash
# Times of two ranks against two threads, of Dask against --jobs 2, and of 1, 2 and 4 processes: the goals of docs/scale.md.
# Usage: bash tools/bench/scale.sh [OBJECTS] [STEPS]; on a machine with two cores and nothing else to do. Needs the extra cluster.
set -euo pipefail
objects=${1:-5000} steps=${2:-60}
tools=$(cd "$(dirname "$0")/.." && pwd)
folder=$(mktemp -d)
cd "$folder"
export OMP_NUM_THREADS=1
make=(learn3d make-dataset --category chair --procedural "$objects" --shards)
rare=(--validate-every 100000 --max-val-images 4 --pictures-every 100000)
train=("$tools/train.py" --data few --category chair --preset proposed --batch-size 128 --iterations "$steps" "${rare[@]}" --overwrite)

# run the rest of the arguments; print the first, and the seconds they took
seconds() {
  local name=$1 start=$EPOCHREALTIME
  shift
  "$@" >>log 2>&1 || { tail -n 20 log; return 1; }
  echo "$name: $(python -c "print(round($EPOCHREALTIME - $start, 1))") s"
}

# print the last time of a step of a training
step() {
  local name=$1
  shift
  "$@" 2>&1 | tee -a log | sed -n "s/^step $steps\/.*  \([0-9]* ms\)\/step.*/$name: \1/p"
}

seconds "data for training" learn3d make-dataset --output few --category chair --procedural 300
for _ in 1 2; do
  OMP_NUM_THREADS=2 step "one process, two threads" python "${train[@]}" --output threads --threads 2
  step "two ranks of one thread" torchrun --standalone --nproc-per-node 2 "${train[@]}" --output ranks --threads 1
done

dask scheduler --port 8786 >scheduler.log 2>&1 &
dask worker tcp://127.0.0.1:8786 --nworkers 2 --nthreads 1 >worker.log 2>&1 &
trap 'kill $(jobs -p); rm -rf "$folder"' EXIT
for _ in 1 2; do
  seconds "$objects objects, --jobs 2" "${make[@]}" --output jobs --jobs 2
  seconds "$objects objects, Dask with two workers" "${make[@]}" --output dask --cluster tcp://127.0.0.1:8786
  diff -r jobs dask && echo "same bytes"
  rm -r jobs dask
done
for jobs in 1 4; do
  seconds "$objects objects, --jobs $jobs" "${make[@]}" --output jobs --jobs "$jobs"
  rm -r jobs
done
