#!/bin/sh
# Writes the briefs of a run, and gives each service of docker-compose.yml its own: as /brief/brief.json, of its volume.
#
# It runs once, before all others and without a network: it is the only one that ever has all briefs. As root, for the
# folders are Docker's; what it leaves belongs to the user of the other services.
set -eu

scenario=${EVEDROP_SCENARIO:-two-eavesdroppers}
owner=${EVEDROP_USER:-1000:1000}
name=$(basename "$scenario" .toml)-$(date +%Y%m%d-%H%M%S)

case $owner in
  *[!0-9:]* | :* | *: | *:*:*)
    echo "evedrop: EVEDROP_USER is $owner, and must be numbers, UID:GID: give \`id -u\`:\`id -g\` (docs/containers.md)" >&2
    exit 2
    ;;
esac

cd /here # a scenario of one's own is named as it is seen from the checkout
# shellcheck disable=SC2086 - options are words
evedrop brief "$scenario" ${EVEDROP_OPTIONS:-} --out /tmp/briefs --results "/runs/$name" \
  --listen tls/0.0.0.0:7447 --connect tls/router:7447 >/tmp/written

eavesdroppers=
for brief in $(cat /tmp/written); do
  process=$(basename "$brief" .json)
  case $process in
    router | sensor | legitimate | observer) ;;
    controller | relay)
      echo "evedrop: $scenario has a $process; docker-compose.yml has no service for one: add it (docs/containers.md), or start" \
        "the run with \`evedrop run\` or, on several hosts, by \`evedrop brief\`" >&2
      exit 2
      ;;
    *) eavesdroppers="$eavesdroppers $process" ;;
  esac
done
# shellcheck disable=SC2086 - names are words
set -- $eavesdroppers
if [ $# -ne 2 ]; then
  echo "evedrop: $scenario has eavesdroppers:${eavesdroppers:- none}; docker-compose.yml has services for two: give" \
    "EVEDROP_SCENARIO one that has two, or change the services (docs/containers.md)" >&2
  exit 2
fi

give() { # process, service
  install --mode 600 "/tmp/briefs/$1.json" "/briefs/$2/brief.json"
  chown "$owner" "/briefs/$2/brief.json"
}
for process in router sensor legitimate observer; do
  give "$process" "$process"
done
give "$1" eavesdropper-1
give "$2" eavesdropper-2
mkdir -m 700 "/runs/$name"
chown "$owner" "/runs/$name"
# Docker makes ./runs as root where it was not there, and then nobody else could start a run in this folder.
if [ "$(stat -c %u /runs)" = 0 ]; then
  chown "$owner" /runs
fi
echo "$scenario: eavesdropper-1 is $1, eavesdropper-2 is $2; results go to runs/$name, readable for user $owner alone"
