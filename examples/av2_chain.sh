#!/usr/bin/env bash
# The whole chain on an Argoverse 2 log: its map, images simulated through its own cameras and poses
# over a world that has changed since, and the map that comes out.
#   examples/av2_chain.sh LOG_DIR OUT [FRAMES] [MODEL]
set -euo pipefail
log=${1:?usage: av2_chain.sh LOG_DIR OUT [FRAMES] [MODEL]}
out=${2:?usage: av2_chain.sh LOG_DIR OUT [FRAMES] [MODEL]}
frames=${3:-32}
model=${4:-rtmap-tiny}
mkdir -p "$out"

# The map that the fleet has; the world lacks one of its crossings and has a divider more.
rtmap import av2 "$log" -o "$out/map"
rtmap simulate changes --map "$out/map" --change delete:ped_crossing --change insert:divider \
    --near "av2:$log" --seed 1 -o "$out/world" --truth "$out/truth.json"

# Three drives of the same way, each with its own light, traffic, GNSS and odometry errors.
for drive in 1 2 3; do
  rtmap simulate images --map "$out/world" --log "av2:$log" --drive "$drive" --seed "$drive" \
      --frames "$frames" -q -o "$out/logs/$drive"
  rtmap infer "$out/logs/$drive" --map "$out/map" --model "$model" -q -o "$out/runs/$drive"
  rtmap localize "$out/runs/$drive" --map "$out/map" --smooth
done

rtmap detect-changes "$out"/runs/* --map "$out/map" -o "$out/changes.geojson"
rtmap crowdsource "$out/runs" --map "$out/map" --message "three drives"

# How good was it?
for drive in 1 2 3; do
  rtmap evaluate poses "$out/runs/$drive" --truth "$out/logs/$drive"
done
rtmap evaluate map "$out/runs/1" --truth "$out/world" --poses "$out/logs/1"
rtmap evaluate map "$out/map" --truth "$out/world" --poses "$out/logs/1" --thresholds 0.2,0.5,1.0
rtmap evaluate changes "$out/changes.geojson" --truth "$out/truth.json"
rtmap map log "$out/map"
