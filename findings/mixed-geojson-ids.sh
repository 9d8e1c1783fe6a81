#!/usr/bin/env bash
# pyogrio 0.13.0 (wheel, with GDAL 3.12.4): of a GeoJSON whose features have whole numbers and text as their `id`
# (RFC 7946 allows both), the text is lost without a warning: there is no field with it, and the feature gets a number that
# no feature of the file has. Text alone comes as the field `id`; whole numbers alone as the numbers of the features, which
# look the same as those that GDAL gives to features without an id.
# Seen: "ids 7, 'way/5', none: fields ['a'], numbers [7, 0, 2], no warning".
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyogrio==0.13.0 numpy==2.4.6
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import json
import sys
import warnings

import pyogrio


def read(*ids):
    ring = [[0, 0], [1, 0], [1, 1], [0, 0]]
    features = [
        {"type": "Feature", "properties": {"a": 1}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
        | ({} if name is None else {"id": name})
        for name in ids
    ]
    with open("a.geojson", "w") as file:
        json.dump({"type": "FeatureCollection", "features": features}, file)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        meta, numbers, _, _ = pyogrio.raw.read("a.geojson", return_fids=True)
    return list(meta["fields"]), numbers.tolist(), len(caught)


mixed, text, whole, without = read(7, "way/5", None), read("x", "y"), read(0, 1), read(None, None)
print("ids 7, 'way/5', none: fields, numbers, warnings", mixed)
print("text:", text, "whole numbers:", whole, "without:", without)
lost = mixed == (["a"], [7, 0, 2], 0)
sys.exit(0 if lost and text[0] == ["id", "a"] and whole == without else 1)
PYTHON
