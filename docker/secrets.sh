#!/bin/sh
# Write the secrets that the containers read: from POSTGRES_PASSWORD, POSTGRES_READ_PASSWORD and
# RAY_AUTH_TOKEN where they are set, otherwise new ones. Files that are there already stay.
#
#     sh docker/secrets.sh
set -eu

folder=$(dirname "$0")/secrets

new_secret() {
    od -An -N24 -tx1 /dev/urandom | tr -d ' \n'
}

# write NAME VALUE: as a file for every user inside a folder for its owner alone, because a
# container reads its own copy as a user of its own.
write() {
    [ -e "$folder/$1" ] && return
    (umask 022 && printf '%s\n' "$2" >"$folder/$1")
}

mkdir -p "$folder"
chmod 700 "$folder"
write postgres_password "${POSTGRES_PASSWORD:-$(new_secret)}"
write postgres_read_password "${POSTGRES_READ_PASSWORD:-$(new_secret)}"
write ray_auth_token "${RAY_AUTH_TOKEN:-$(new_secret)}"
