#!/usr/bin/env bash
# The ring closed: a place without a map. Drives with LiDAR become clouds and lanes, somebody draws
# the crossings by hand, the labels train a network, the network reads the next drives, and what has
# changed since, or was missing, comes into the map. Town, sweeps, images and changes are simulated.
#   examples/label_ring.sh OUT [STEPS] [LENGTH_M] [DRIVES] [WIDTH_PX]
# STEPS 0: without training, the network as it was shipped reads the next drives.
set -euo pipefail
out=${1:?usage: label_ring.sh OUT [STEPS] [LENGTH_M] [DRIVES] [WIDTH_PX]}
steps=${2:-40}
length=${3:-200}
drives=${4:-4}
width=${5:-512}
mkdir -p "$out/runs"
rtmap simulate town --seed 4 --size 300 --style campus -o "$out/world"

# A survey: LiDAR and a good receiver, and the images of the same drives. There is no map.
snap=() poses=()
for k in $(seq "$drives"); do
  rtmap simulate lidar --map "$out/world" --log town: --route turning --drive "$k" --length "$length" \
      --spacing 4 --gnss rtk -q -o "$out/survey/$k"
  rtmap label cloud "$out/survey/$k" -q -o "$out/clouds/$k"
  rtmap simulate images --map "$out/world" --log "$out/survey/$k" --rig default --seed "$k" \
      --width "$width" -q -o "$out/logs/$k"
  snap+=(--snap "$out/clouds/$k") poses+=(--poses "$out/clouds/$k")
done
rtmap label lanes "$out"/clouds/* "${snap[@]}" -o "$out/labels"

# By hand: in QGIS somebody draws the crossings that lie on these lanes (here: those of the town).
rtmap export geojson "$out/labels" -o "$out/labels.geojson"
rtmap export geojson "$out/world" -o "$out/world.geojson"
python3 - "$out" <<'EDIT'
import json, sys
out = sys.argv[1]
labels, world = (json.load(open(f"{out}/{n}.geojson")) for n in ("labels", "world"))
at = [p for f in labels["features"] for p in f["geometry"]["coordinates"] if len(p) < 4]
for f in world["features"]:
    if f["properties"]["class"] == "ped_crossing":
        ring = f["geometry"]["coordinates"][0]
        x, y = (sum(p[k] for p in ring[:-1]) / (len(ring) - 1) for k in (0, 1))
        if any(abs(x - p[0]) * 73e3 < 6 and abs(y - p[1]) * 111e3 < 6 for p in at):
            f["properties"] = {"id": f"hand-{f['id']}", "class": "ped_crossing"}
            f["geometry"]["coordinates"] = [[p[:2] for p in ring]]
            labels["features"].append(f | {"id": f["properties"]["id"]})
json.dump(labels, open(f"{out}/edited.geojson", "w"))
EDIT
rtmap label merge "$out/labels.geojson" "$out/edited.geojson" --into "$out/labels"

# Labels train a network: lines that were seen, not the widths that were assumed.
rtmap label frames "$out/labels" "$out"/logs/* "${poses[@]}" --split paper --max-sigma 0.5 -q \
    -o "$out/frames"
cp -r "$out/frames/map" "$out/map"
model=rtmap-tiny
if [ "$steps" -gt 0 ]; then
  rtmap train -o "$out/weights.pt" --data "$out/frames/paper/train" --map "$out/frames/map" \
      --init rtmap-tiny --rate 3e-5 --steps "$steps" -q
  rtmap export-model "$out/weights.pt" -o "$out/model.onnx"
  model=$out/model.onnx
fi

# The world goes on without asking: the same ways are driven again and read with that network.
rtmap simulate changes --map "$out/world" --change delete:ped_crossing --change insert:ped_crossing \
    --near "$out/logs/1" --seed 1 -o "$out/changed" --truth "$out/truth.json"
for k in $(seq "$drives"); do
  rtmap simulate images --map "$out/changed" --log "$out/logs/$k" --seed "$((k + 10))" \
      --width "$width" -q -o "$out/later/$k"
  rtmap infer "$out/later/$k" --map "$out/map" --model "$model" -q -o "$out/runs/$k"
  rtmap localize "$out/runs/$k" --map "$out/map" --smooth
done
rtmap update "$out/runs" --map "$out/map" -o "$out/changes.geojson" --report "$out/report"
rtmap map review "$out/changes.geojson" --accept-if 'probability>0.9'
rtmap map apply "$out/map" "$out/changes.geojson" || echo "nothing to apply"
rtmap map log "$out/map"

# How good was it? Labels hold the lanes that were driven, the world everything.
echo "== the network on frames that were not trained on, against the world: before, after"
test=$out/frames/paper/test/000
rtmap infer "$test" -q -o "$out/test/before"
rtmap infer "$test" --model "$model" -q -o "$out/test/after"
for run in before after; do
  rtmap evaluate map "$out/test/$run" --truth "$out/world" --poses "$test"
done
echo "== a later drive, localized on the labels"
rtmap evaluate poses "$out/runs/1" --truth "$out/later/1"
echo "== the two changes of the world (what the labels lacked besides counts as false here)"
rtmap evaluate changes "$out/changes.geojson" --truth "$out/truth.json"
echo "== the map against the changed world: before, after"
for map in "$out/frames/map" "$out/map"; do
  rtmap evaluate map "$map" --truth "$out/changed" --poses "$out/later/1" --thresholds 1,2,5
done
