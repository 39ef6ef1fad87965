#!/bin/bash
# A training run under Slurm that goes on after a time limit, a preemption or a lost node:
#   sbatch examples/slurm.sh runs/mine samples=1e9 num_worlds=16384
#   sbatch --array=1-3 examples/slurm.sh runs/mine_seed%a seed=%a samples=1e9      # %a: number in the array
# The first argument is the run folder, the others are those of pace train. docs/cluster.md explains it.
#SBATCH --job-name=pace
#SBATCH --time=12:00:00
#SBATCH --cpus-per-task=16
#SBATCH --gpus-per-task=1
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=slurm-%x-%A_%a.log
#SBATCH --signal=B:TERM@180

set -u
SAVED=75  # exit status of pace train after SIGTERM, when the checkpoint is written

if [ $# -eq 0 ] || [[ $1 == *=* ]]; then
  echo "usage: sbatch $0 RUN_FOLDER [key=value ...]" >&2
  exit 2
fi
arguments=("${@//%a/${SLURM_ARRAY_TASK_ID:-0}}")
run=${arguments[0]}
if compgen -G "$run/checkpoints/update_*/checkpoint.json" > /dev/null; then
  arguments=("resume=$run")  # with the limits that it was started with
else
  arguments=("out=$run" "${arguments[@]:1}")
fi

# In the background, so that this shell gets its signals at once and hands them on.
${PYTHON:-python} -m pace.rl.train "${arguments[@]}" progress=false &
training=$!
trap 'kill -TERM $training' TERM
while true; do
  wait $training
  status=$?
  kill -0 $training 2> /dev/null || break  # else a signal has ended the wait, not the training
done

if [ $status -eq $SAVED ]; then
  scontrol requeue "$SLURM_JOB_ID"
fi
exit $status
