#!/usr/bin/env bash
# pyproj 3.7.2: `Transformer.get_last_used_operation` raises ProjError after a transform that worked, where PROJ has
# a single operation between the CRSs: NAD83 to NAD83(2011) without grids, which moves nothing.
# The accuracy must then be read of the transformer itself, and is -1, unknown.
# Seen: "moved by 0.0 m", "ProjError: Last used operation not found. ...", "-1.0".
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check pyproj==3.7.2
"$work/venv/bin/python" - <<'PYTHON'
import sys

import pyproj

forward = pyproj.Transformer.from_crs("EPSG:26910", "EPSG:6339", always_xy=True)
x, y = forward.transform(550000.0, 4180000.0)
print("moved by", round(abs(x - 550000.0) + abs(y - 4180000.0), 6), "m")
try:
    raised = forward.get_last_used_operation() is None
except pyproj.exceptions.ProjError as error:
    raised = True
    print("ProjError:", error)
print(forward.accuracy)
sys.exit(0 if raised and forward.accuracy == -1 else 1)
PYTHON
