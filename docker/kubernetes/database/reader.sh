#!/bin/sh
# Make the user dopt_read, who can only read, with the password of its secret. PostgreSQL's image runs
# this for a new database. For one that is there, and for a new password:
#
#     docker compose exec --user postgres db sh /docker-entrypoint-initdb.d/reader.sh
#     kubectl exec dopt-database-0 -- sh /docker-entrypoint-initdb.d/reader.sh
set -e

READ_PASSWORD_FILE=${READ_PASSWORD_FILE:-/run/secrets/postgres_read_password}
export READ_PASSWORD_FILE

psql --no-psqlrc --quiet --set=ON_ERROR_STOP=1 \
    --username="$POSTGRES_USER" --dbname="$POSTGRES_DB" <<'SQL'
\set password `head -n 1 "$READ_PASSWORD_FILE"`
SELECT 'CREATE ROLE dopt_read'
WHERE NOT EXISTS (SELECT FROM pg_roles WHERE rolname = 'dopt_read') \gexec
ALTER ROLE dopt_read LOGIN PASSWORD :'password';
GRANT SELECT ON ALL TABLES IN SCHEMA public TO dopt_read;
ALTER DEFAULT PRIVILEGES IN SCHEMA public GRANT SELECT ON TABLES TO dopt_read;
SQL
