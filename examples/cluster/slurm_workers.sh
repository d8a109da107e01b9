#!/bin/bash
#SBATCH --job-name=hoigs-work
#SBATCH --array=0-7
#SBATCH --cpus-per-task=8
#SBATCH --gpus=1
#SBATCH --time=12:00:00
#SBATCH --requeue
# Eight workers of one batch, without Ray. Each may be stopped at any time.
#   sbatch slurm_workers.sh /shared/rows.csv /shared/runs/lab
set -euo pipefail

# every task may run this: leases keep them apart
srun hoigs batch "$1" --out "$2" --threads "$SLURM_CPUS_PER_TASK"
