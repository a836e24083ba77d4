#!/bin/sh
# Set up the database of POSTGRES_USER on the first start, then serve it.
set -eu

if [ ! -e "$PGDATA/PG_VERSION" ]; then
    initdb --username="$POSTGRES_USER" --pwfile="$POSTGRES_PASSWORD_FILE" \
        --encoding=UTF8 --locale=C.UTF-8 --auth-local=trust --auth-host=scram-sha-256 >/dev/null
    echo "host all all all scram-sha-256" >>"$PGDATA/pg_hba.conf"
    pg_ctl start --silent --wait --options="-c listen_addresses=" --log="$PGDATA/setup.log"
    createdb --username="$POSTGRES_USER" "$POSTGRES_DB"
    for script in /docker-entrypoint-initdb.d/*.sh; do
        [ ! -r "$script" ] || sh "$script"
    done
    pg_ctl stop --silent --wait
fi
exec postgres -c listen_addresses='*'
