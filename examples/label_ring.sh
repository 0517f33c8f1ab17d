#!/usr/bin/env bash
# The ring closed: drives without a map become labels, labels train a network, the network reads the
# next drives, and what has changed since comes into the map. Town, images and changes are simulated.
#   examples/label_ring.sh OUT [STEPS] [LENGTH_M] [WIDTH_PX]
set -euo pipefail
out=${1:?usage: label_ring.sh OUT [STEPS] [LENGTH_M] [WIDTH_PX]}
steps=${2:-200}
length=${3:-300}
width=${4:-512}
mkdir -p "$out/runs"
rtmap simulate town --seed 4 --size 300 -o "$out/world"

drive() { # drive NUMBER WORLD: images of a drive through it
  rtmap simulate images --map "$2" --log town: --seed 1 --drive "$1" --length "$length" \
      --width "$width" --spacing 4 -q -o "$out/logs/$1"
}

# A survey: the vehicle knows where it is (its poses are laid beside the run), there is no map.
for k in 1 2; do
  drive "$k" "$out/world"
  rtmap infer "$out/logs/$k" -q -o "$out/survey/$k"
  cp "$out/logs/$k/truth/poses.parquet" "$out/survey/$k/poses.parquet"
done
rtmap label lanes "$out/survey/1" "$out/survey/2" --snap "$out/survey/1" --snap "$out/survey/2" \
    -o "$out/labels"

# By hand: edit labels.osm in JOSM or the Vector Map Builder; here somebody only looked at it.
rtmap export lanelet2 "$out/labels" -o "$out/labels.osm"
cp "$out/labels.osm" "$out/edited.osm"
rtmap label merge "$out/labels.osm" "$out/edited.osm" --into "$out/labels"

# Labels train a network.
rtmap label frames "$out/labels" "$out/logs/1" "$out/logs/2" --split paper -q -o "$out/frames"
rtmap train -o "$out/weights.pt" --data "$out/frames/paper/train" --map "$out/frames/map" \
    --init rtmap-tiny --rate 1e-4 --steps "$steps" -q
rtmap export-model "$out/weights.pt" -o "$out/model.onnx"

# The world goes on without asking: two more drives of the same ways, read with that network.
rtmap simulate changes --map "$out/world" --change delete:divider --change insert:ped_crossing \
    --near "$out/logs/1" --seed 1 -o "$out/changed" --truth "$out/truth.json"
for k in 1 2; do
  rtmap simulate images --map "$out/changed" --log "$out/logs/$k" --seed "$((k + 10))" \
      --width "$width" -q -o "$out/later/$k"
  rtmap infer "$out/later/$k" --map "$out/frames/map" --model "$out/model.onnx" -q \
      -o "$out/runs/$k"
  rtmap localize "$out/runs/$k" --map "$out/frames/map" --smooth
done
rtmap update "$out/runs" --map "$out/frames/map" -o "$out/changes.geojson" --report "$out/report"
rtmap map review "$out/changes.geojson" --accept-if 'probability>0.9'
rtmap map apply "$out/frames/map" "$out/changes.geojson" || echo "nothing to apply"
rtmap map log "$out/frames/map"
