#!/usr/bin/env bash
# A construction zone from its first day to its last: a street of a simulated town is narrowed, its
# lanes are moved, delineators stand in the road; the map follows, and comes back afterwards.
#   examples/construction_zone.sh OUT [METRES] [DRIVES]
set -euo pipefail
out=${1:?usage: construction_zone.sh OUT [METRES] [DRIVES]}
metres=${2:-40}
drives=${3:-3}
mkdir -p "$out"

# A town, its map, and a way through it (small images: only its poses are needed).
rtmap simulate town --seed 4 -o "$out/world"
cp -r "$out/world" "$out/map"
rtmap simulate images --map "$out/world" --log town:"$out/world" --route straight --width 64 -q -o "$out/way"

# The world during the works; the truth file also says where the delineators stand.
rtmap simulate changes --map "$out/world" --works "$metres" --near "$out/way" --seed 1 \
    -o "$out/works" --truth "$out/works.json"

# One drive after another through a world (NAME), localized on the map as it is then.
drive() { # NAME FIRST [OPTION...]
  local name=$1 first=$2; shift 2
  for k in $(seq "$first" $((first + drives - 1))); do
    rtmap simulate observations --map "$out/$name" --log "$out/way" --preset mild --traversal "$k" \
        "$@" -q -o "$out/runs-$name/$k"
    rtmap localize "$out/runs-$name/$k" --map "$out/map" --smooth
  done
}

drive works 0 --works "$out/works.json"
rtmap detect-changes "$out"/runs-works/? --map "$out/map" --displaced -o "$out/detected.geojson"
rtmap update "$out/runs-works" --map "$out/map" -o "$out/during.geojson" --report "$out/during"
rtmap map apply "$out/map" "$out/during.geojson" --all -m "works"

drive world "$drives"
rtmap update "$out/runs-world" --map "$out/map" -o "$out/after.geojson" --report "$out/after"
rtmap map apply "$out/map" "$out/after.geojson" --all -m "the works are gone"

# The same drives have nothing more to say.
rtmap update "$out/runs-world" --map "$out/map" -o "$out/again.geojson"
rtmap map log "$out/map"
