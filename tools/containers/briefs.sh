#!/bin/sh
# Writes the briefs of a run, and gives each service of docker-compose.yml its own: as /brief/brief.json, in its volume.
#
# It runs once, before all others and without a network, and is the only one that ever has all briefs. It runs as root, because
# the folders are Docker's; the files that it leaves belong to the user of the other services.
set -eu

scenario=${EVEDROP_SCENARIO:?the scenario of docker-compose.yml}
owner=${EVEDROP_USER:-1000:1000}
name=$(basename "$scenario" .toml)-$(date +%Y%m%d-%H%M%S)

case $owner in
  *[!0-9:]* | :* | *: | *:*:*)
    echo "evedrop: EVEDROP_USER is $owner, and must be numbers, UID:GID: give \`id -u\`:\`id -g\` (docs/containers.md)" >&2
    exit 2
    ;;
esac

# The folders are those of the processes that docker-compose.yml has services for.
services=$(cd /briefs && echo *)
set -- --listen tls/0.0.0.0:7447 --connect tls/router:7447
if [ -d /briefs/relay ]; then
  set -- "$@" --relay tls/0.0.0.0:7447 --relay-connect tls/relay:7447
fi

other() { # what is wrong
  echo "evedrop: $scenario $1, and docker-compose.yml has services for: $services; write files for this scenario with" \
    "\`evedrop brief $scenario --compose DIR\` (docs/containers.md)" >&2
  exit 2
}

cd /here # a scenario of one's own is named as it is seen from the folder of docker-compose.yml
# shellcheck disable=SC2086 - options are words
if ! evedrop brief "$scenario" ${EVEDROP_OPTIONS:-} --out /tmp/briefs --results "/runs/$name" "$@" >/tmp/written 2>/tmp/said; then
  if grep -q -e --relay /tmp/said; then
    if [ -d /briefs/relay ]; then other "has one router"; else other "has two routers"; fi
  fi
  cat /tmp/said >&2
  exit 2
fi
cat /tmp/said >&2
processes=$(cd /tmp/briefs && for brief in *.json; do echo "${brief%.json}"; done)

# shellcheck disable=SC2086 - names are words
if [ "$(printf '%s\n' $services | sort)" != "$(printf '%s\n' $processes | sort)" ]; then
  # shellcheck disable=SC2086,SC2116
  other "has the processes: $(echo $processes)"
fi

for process in $processes; do
  install --mode 600 "/tmp/briefs/$process.json" "/briefs/$process/brief.json"
  chown "$owner" "/briefs/$process/brief.json"
done
mkdir -m 700 "/runs/$name"
chown "$owner" "/runs/$name"
# Docker makes ./runs as root if it does not exist, and then no other user could start a run in this folder.
if [ "$(stat -c %u /runs)" = 0 ]; then
  chown "$owner" /runs
fi
echo "$scenario: results go to runs/$name, readable for user $owner alone"
