#!/usr/bin/env bash
# DracoPy 2.2.0 refuses the normals that it gave itself: `decode` returns them as float32, the type of glTF, and `encode` asserts
# that they are float64 ("Normals must be float"), while it takes points in float32.
# Seen: decoded as float32; AssertionError for float32, none for float64.
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet DracoPy==2.2.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import DracoPy
import numpy as np

points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
faces = np.array([[0, 1, 2]], np.uint32)
normals = np.array([[0, 0, 1]] * 3, np.float64)
found = DracoPy.decode(DracoPy.encode(points, faces, normals=normals)).normals
try:
    DracoPy.encode(points, faces, normals=found)
    message = ""
except AssertionError as error:
    message = str(error)
print(found.dtype, repr(message))
sys.exit(found.dtype != np.float32 or message != "Normals must be float")
PYTHON
