#!/usr/bin/env bash
# pyproj 3.7.2 (PROJ 9.5.1, wheel without grids): WGS 84 to the British national grid is a Helmert transformation.
# Behaviour: no warning, accuracy 2 m where the grid OSTN15 would give 0.1 m; `only_best=True` raises only without
# `always_xy=True`, which nearly all programs set. Seen: "2.0 m", "only_best with always_xy: (147000" and
# "only_best without: ProjError".
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check pyproj==3.7.2
"$work/venv/bin/python" -W error - <<'PYTHON'
import sys

import pyproj

lon, lat = -5.5343, 50.1187  # Penzance
forward = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:27700", always_xy=True)
forward.transform(lon, lat)
accuracy = forward.get_last_used_operation().accuracy
print(accuracy, "m", forward.get_last_used_operation().description)
best = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:27700", always_xy=True, only_best=True)
try:
    moved = best.transform(lon, lat, errcheck=True)
except pyproj.exceptions.ProjError as error:
    moved = type(error).__name__
print("only_best with always_xy:", moved)
try:
    plain = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:27700", only_best=True).transform(lat, lon, errcheck=True)
except pyproj.exceptions.ProjError as error:
    plain = type(error).__name__
print("only_best without:", plain)
sys.exit(0 if accuracy == 2.0 and isinstance(moved, tuple) and plain == "ProjError" else 1)
PYTHON
