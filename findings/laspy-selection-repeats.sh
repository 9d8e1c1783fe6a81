#!/usr/bin/env bash
# laspy 2.7.0 with lazrs 0.8.2, Python 3.11: LAZ of point formats 6 to 10 is stored field by field, and
# `laspy.open(..., decompression_selection=...)` leaves fields out. A field that is left out is not zero: it has the
# first value of its chunk in every point.
# Seen: withheld flags 1 0 0 1 0 0 become 1 1 1 1 1 1 where FLAGS is not selected, and classes 1 2 3 4 5 6 become
# 1 1 1 1 1 1 without CLASSIFICATION; no warning. A reader that filters by a field must select it.
# Exit 0: as described. Exit 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet laspy==2.7.0 lazrs==0.8.2 numpy==2.2.6
"$folder/venv/bin/python" - <<'PY'
import io
import sys

import laspy
import numpy as np
from laspy import DecompressionSelection as Fields

las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
las.x = np.arange(6)
las.withheld = np.arange(6) % 3 == 0
las.classification = np.arange(6) + 1
file = io.BytesIO()
las.write(file, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)


def read(fields):
    source = io.BytesIO(file.getvalue())
    with laspy.open(source, laz_backend=laspy.LazBackend.Lazrs, decompression_selection=fields) as reader:
        return reader.read()


whole, part = read(Fields.all()), read(Fields.XY_RETURNS_CHANNEL | Fields.Z)
found = [np.asarray(one).tolist() for one in (whole.withheld, part.withheld, whole.classification, part.classification)]
for name, values in zip(("withheld", "not selected", "classes", "not selected"), found):
    print(f"{name:13}", *values)
expected = [[1, 0, 0, 1, 0, 0], [1] * 6, [1, 2, 3, 4, 5, 6], [1] * 6]
sys.exit(0 if found == expected else 1)
PY
