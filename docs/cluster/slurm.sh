#!/bin/bash
# One training on eight machines with four GPUs each: sbatch slurm.sh
#SBATCH --job-name=chair
#SBATCH --nodes=8
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=4
#SBATCH --cpus-per-task=16
#SBATCH --time=24:00:00
#SBATCH --signal=TERM@120
set -euo pipefail
host=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
options=(--data /shared/big --category chair --output /shared/runs/chair --batch-size 1024 --device cuda)
if [ -e /shared/runs/chair/config.json ]; then
    options=(--output /shared/runs/chair --resume)
fi
srun torchrun --nnodes "$SLURM_NNODES" --nproc-per-node 4 \
    --rdzv-backend c10d --rdzv-endpoint "$host:29500" --rdzv-id "$SLURM_JOB_ID" \
    tools/train.py "${options[@]}"
