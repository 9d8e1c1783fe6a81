#!/usr/bin/env bash
# laspy 2.7.0 with pyproj 3.7.2, Python 3.11: a projection that has no EPSG code is written as key 3072 = 32767
# (user-defined), its parameters in further keys, beside the geographic CRS it is based on (2048 = 4269).
# `LasHeader.parse_crs` gives the latter, which has degrees, though key 1024 = 1 says that coordinates are projected.
# Seen: EPSG:4269, unit degree; no warning. A cloud in metres is taken for one in degrees.
# Exit 0: as described. Exit 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet laspy==2.7.0 pyproj==3.7.2 numpy==2.2.6
"$folder/venv/bin/python" - <<'PY'
import struct
import sys

import laspy
from laspy.vlrs.known import GeoKeyDirectoryVlr

# Transverse Mercator (3075 = 1) of the user's own, in metres (3076 = 9001), on NAD83.
rows = [(1024, 0, 1, 1), (2048, 0, 1, 4269), (3072, 0, 1, 32767), (3074, 0, 1, 32767), (3075, 0, 1, 1), (3076, 0, 1, 9001)]
header = laspy.LasHeader(point_format=1, version="1.2")
directory = GeoKeyDirectoryVlr()
directory.parse_record_data(struct.pack(f"<{4 + 4 * len(rows)}H", 1, 1, 0, len(rows), *sum(rows, ())))
header.vlrs.append(directory)
crs = header.parse_crs()
found = crs.to_epsg(), crs.axis_info[0].unit_name
print(*found)
sys.exit(0 if found == (4269, "degree") else 1)
PY
