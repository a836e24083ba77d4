#!/bin/sh
# What the image runs: head | worker | launch ... | orchestrate ... | analysis ... | COMMAND ...
#
#     DOPT_HEAD     address of the cluster's head, such as head:6379; without it a launch is alone
#     DOPT_NODE_IP  address of this container for the others, by default its first one
#     DOPT_CPUS     trials at once on this node, by default one for each core
#     DOPT_DB       database, without its password, which is a file: /run/secrets/postgres_password
#     DOPT_READ_DB  the same for statements of the browser: /run/secrets/postgres_read_password
set -eu

SECRETS=/run/secrets
NODE_FILE=/tmp/dopt-node # tells the health check which node of which cluster runs here

# Put the passwords where PostgreSQL's library looks for them, which takes the first that fits: no
# command line and no variable has them.
read_passwords() {
    rm -f "$HOME/.pgpass"
    for entry in dopt_read:postgres_read_password '*:postgres_password'; do
        if [ -r "$SECRETS/${entry#*:}" ]; then
            # A line for every server; colons and backslashes are escaped.
            (umask 077 && sed -n "1s/[\\\\:]/\\\\&/g; 1s/^/*:*:*:${entry%:*}:/p" \
                "$SECRETS/${entry#*:}" >>"$HOME/.pgpass")
        fi
    done
}

# Start this container's node with the words given and the options of every node.
start_node() {
    set -a # all nodes need the same settings; the launch has those of its node
    # shellcheck source=/dev/null
    . orchestrate/executors/ray/ray.env
    set +a
    address=${DOPT_NODE_IP:-$(hostname -i | cut -d ' ' -f 1)}
    echo "${DOPT_HEAD:-$address:6379} $address" >"$NODE_FILE"
    "$@" --node-ip-address="$address" --object-store-memory=268435456 \
        --disable-usage-stats --include-log-monitor=false
}

case "${1:-}" in
head)
    start_node exec ray start --block --head --port=6379 --include-dashboard=false \
        ${DOPT_CPUS:+--num-cpus="$DOPT_CPUS"}
    ;;
worker)
    python -c 'from dopt.kernel import warm_up; warm_up()'
    start_node exec ray start --block \
        --address="${DOPT_HEAD:?is missing: give the address of the head, such as head:6379}" \
        ${DOPT_CPUS:+--num-cpus="$DOPT_CPUS"}
    ;;
launch)
    shift
    read_passwords
    if [ -n "${DOPT_HEAD:-}" ]; then
        # A launch reaches the cluster through a node of its own, which runs no trials.
        [ -e "$NODE_FILE" ] || start_node ray start --address="$DOPT_HEAD" --num-cpus=0 >/dev/null
        set -- "$@" executor=ray launch.ray.address="$DOPT_HEAD"
    fi
    exec python orchestrate/launch.py "$@"
    ;;
orchestrate | analysis)
    read_passwords
    exec python -m "$@"
    ;;
*)
    exec "$@"
    ;;
esac
