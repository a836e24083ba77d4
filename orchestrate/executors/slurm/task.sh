# shellcheck shell=bash disable=SC2154 # workers, walltime and leave are set above

# The number of a task; SLURM_JOB_ID of the last one means the whole array.
task=${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID

# The task has left before SLURM warns it of its end.
end=${SLURM_JOB_END_TIME:-$(squeue --noheader --jobs="$task" --format=%e | date --file=- +%s)}
seconds=$((${end:-$(date +%s) + walltime} - $(date +%s) - leave))

"${workers[@]}" --until "${seconds}s" &
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
