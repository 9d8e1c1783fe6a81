#!/usr/bin/env bash
# cjio 0.10.1 `crs_reproject 4326` writes a file whose transform has the scale 0, 0, 0: it keeps a scale of some 1e-8 degrees
# in memory and writes six decimals of it. So all vertices of the file are one place, and no error is reported. Its first
# axis is the latitude, as EPSG:4326 has it, where the file before had the easting first. To a CRS in metres it is right.
# Seen: scales [0.0, 0.0, 0.0] for 4326, [0.001, 0.001, 0.001] for 32631; latitude 52.37 first.
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet cjio==0.10.1 pyproj==3.7.2
cd "$folder"
cat > triangle.city.json <<'JSON'
{"type": "CityJSON", "version": "2.0",
 "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/28992"},
 "transform": {"scale": [0.001, 0.001, 0.001], "translate": [121000.0, 487000.0, 0.0]},
 "CityObjects": {"a": {"type": "Building", "geometry": [
  {"type": "MultiSurface", "lod": "0", "boundaries": [[[0, 1, 2]]]}]}},
 "vertices": [[0, 0, 0], [10000, 0, 0], [0, 10000, 0]]}
JSON
for code in 4326 32631; do
    venv/bin/cjio triangle.city.json crs_reproject "$code" save "$code.city.json" > /dev/null
done
venv/bin/python - <<'PYTHON'
import json
import sys

degrees, metres = (json.load(open(f"{code}.city.json")) for code in (4326, 32631))
scales = [model["transform"]["scale"] for model in (degrees, metres)]
first = degrees["transform"]["translate"][0]
print(scales, len(set(map(tuple, degrees["vertices"]))), "different vertices; first axis", round(first, 2))
sys.exit(scales != [[0.0] * 3, [0.001] * 3] or round(first, 2) != 52.37)
PYTHON
