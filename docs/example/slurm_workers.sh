#!/bin/bash
# Workers of a registered grid, as a job array of SLURM (docs/many_machines.md).
#SBATCH --job-name=dopt --array=1-8 --nodes=1 --ntasks=1 --cpus-per-task=4 --time=1:00:00
#SBATCH --open-mode=append --requeue --signal=B:USR1@60

# The number of a task; SLURM_JOB_ID of the last one means the whole array.
task=${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID

# The task leaves before SLURM warns it of its end: at most 60 s earlier than it is asked to.
end=${SLURM_JOB_END_TIME:-$(squeue --noheader --jobs="$task" --format=%e | date --file=- +%s)}
until=${end:+--until=$((end - $(date +%s) - 120))s}

python -m orchestrate work --processes="$SLURM_CPUS_PER_TASK" ${until:+"$until"} "$@" &
pid=$!
trap 'kill -USR1 "$pid" 2>/dev/null' USR1 TERM
# A signal ends the wait; the workers end within seconds.
while
    wait "$pid"
    code=$?
    ((code > 128)) && kill -0 "$pid" 2>/dev/null
do :; done

# SLURM queues a task again that it has stopped, but not one that has left after a warning.
if ((code > 128)) && [[ $(squeue --noheader --jobs="$task" --format=%T) == RUNNING ]]; then
    scontrol requeue "$task"
fi
# Where every trial has an outcome, tasks that wait would find nothing to do.
((code > 1)) || scancel --quiet --state=PENDING "$SLURM_ARRAY_JOB_ID"
exit "$code"
