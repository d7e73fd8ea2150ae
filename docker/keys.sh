#!/bin/sh
# Creates a key pair for each host that runs in a container, and writes the public keys into the
# launch file: docker/keys.sh LAUNCH_FILE [HOST...].  On three machines, create the keys on each of
# them (docs/deploy.md), so that no secret key leaves its computer.
set -eu
launch_file=$1
shift
[ $# -gt 0 ] || set -- main left right
here=$(dirname "$0")
for host in "$@"; do
    mkdir -p -m 700 "$here/keys/$host"
    FLEXSHEET_KEYS="$here/keys/$host" flexsheet keys "$host"
    FLEXSHEET_KEYS="$here/keys/$host" flexsheet keys "$host" --install "$launch_file"
done
# The user in the containers is 1000.
[ "$(id -u)" -ne 0 ] || chown -R 1000 "$here/keys"
