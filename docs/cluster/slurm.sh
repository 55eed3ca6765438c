#!/usr/bin/env bash
# A Ray cluster inside a SLURM job, and a grid on it:  sbatch docs/cluster/slurm.sh paper.yaml
# When the job's time is up, submit it again: finished runs stay, the others are resumed.
#SBATCH --job-name=mbn-grid
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=32
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@60
set -euo pipefail
export OMP_NUM_THREADS=1 RAY_USAGE_STATS_ENABLED=0
spec=${1:?usage: sbatch slurm.sh SPEC.yaml}
head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
address=$(srun --nodes=1 --ntasks=1 -w "$head" hostname --ip-address | cut -d ' ' -f 1):6379
options=(--num-cpus "$SLURM_CPUS_PER_TASK" --disable-usage-stats --block)

srun --nodes=1 --ntasks=1 --overlap -w "$head" \
  ray start --head --port 6379 --include-dashboard=false "${options[@]}" &
sleep 15
if ((SLURM_NNODES > 1)); then
  srun --nodes=$((SLURM_NNODES - 1)) --ntasks=$((SLURM_NNODES - 1)) --overlap --exclude "$head" \
    ray start --address "$address" "${options[@]}" &
fi
mbn grid "$spec" --engine ray --address "$address"
