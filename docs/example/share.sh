#!/bin/bash
# One share of a grid, for machines with a shared folder and no database server (docs/many_machines.md):
#     bash docs/example/share.sh FOLDER NUMBER SHARES [WORDS OF THE LAUNCH]
# runs the seeds NUMBER - 1, NUMBER - 1 + SHARES, ... below SEEDS into a file on a disk of this machine.
folder=${1:?FOLDER NUMBER SHARES are expected} number=${2:?} shares=${3:?}
shift 3
disk=$(mktemp -d "${TMPDIR:-/var/tmp}/dopt.XXXXXX") copy=$folder/$number-of-$shares.db
export DOPT_DB=sqlite:///$disk/share.db

save() { # the copy gets its name when it is complete
    rm -f "$disk/copy.db" "$copy.partial"
    python -m orchestrate backup "$disk/copy.db" >/dev/null && cp "$disk/copy.db" "$copy.partial" &&
        mv "$copy.partial" "$copy"
}

mkdir -p "$folder"
[[ ! -f $copy ]] || cp "$copy" "$disk/share.db" # go on, perhaps for another machine

python orchestrate/launch.py -m "seed=range($((number - 1)),${SEEDS:-100},$shares)" "$@" &
launch=$!
trap 'kill "$launch" 2>/dev/null' TERM INT USR1
for ((second = 1; ; second++)); do
    kill -0 "$launch" 2>/dev/null || break
    ((second % ${EVERY:-60})) || save
    sleep 1 &
    wait $!
done
wait "$launch"
code=$?
if [[ ! -f $disk/share.db ]] || save; then
    rm -r "$disk"
else
    echo "error: $copy cannot be written: the results are in $disk/share.db" >&2
    code=75
fi
exit "$code"
