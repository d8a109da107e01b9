#!/bin/bash
#SBATCH --job-name=hoigs
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=16
#SBATCH --gpus-per-node=2
#SBATCH --time=12:00:00
#SBATCH --requeue
# One batch on four machines by Ray. Submit it again after a stop: it continues.
#   sbatch slurm_ray.sh /shared/rows.csv /shared/runs/lab
set -euo pipefail

manifest=$1
out=$2
export RAY_USAGE_STATS_ENABLED=0
head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
port=$((20000 + SLURM_JOB_ID % 20000))

# starts Ray on every machine, runs the command on the first one, and ends Ray with it
srun --nodes="$SLURM_NNODES" --ntasks="$SLURM_NNODES" \
  ray symmetric-run --address "$head:$port" --min-nodes "$SLURM_NNODES" \
  --num-cpus "$SLURM_CPUS_PER_TASK" --num-gpus "$SLURM_GPUS_ON_NODE" -- \
  hoigs batch "$manifest" --out "$out" --executor ray --address "$head:$port" --jobs 8 --threads 8
