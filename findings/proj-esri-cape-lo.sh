#!/usr/bin/env bash
# pyproj 3.7.2 (PROJ 9.5.1): ESRI:102470 "Cape_Lo15", and others of the Lo zones of southern Africa, are in the
# register and can be made, but no transformation to or from them: PROJ writes a scale of 0.
# EPSG has the same zones (EPSG:22275) with axes to the west and south alone, and these work.
# Seen: "ESRI:102470 ProjError: ... Invalid value for k/k_0: it should be > 0", "EPSG:22275 works".
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check pyproj==3.7.2
"$work/venv/bin/python" - <<'PYTHON'
import sys

import pyproj

found = {}
for code in ("ESRI:102470", "EPSG:22275"):
    crs = pyproj.CRS(code)
    try:
        pyproj.Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True).transform(15.1, -22.5)
        found[code] = "works"
    except pyproj.exceptions.ProjError as error:
        found[code] = f"ProjError: {error}"
    print(code, found[code])
sys.exit(0 if "k_0" in found["ESRI:102470"] and found["EPSG:22275"] == "works" else 1)
PYTHON
