#!/usr/bin/env bash
# laspy 2.7.0 with pyproj 3.7.2, Python 3.11: `LasHeader.parse_crs` reads key 3072 (or 2048) of the GeoTIFF keys, and
# nothing else. Vertical keys (4096 = 6360: NAVD88 in US survey feet; 4099 = 9003: heights in that unit) and the
# linear unit of the plane (3076 = 9003) are passed over.
# Seen: for all three files EPSG:26910, in metres, not compound; no warning. Heights are 3.28 times too large, or
# coordinates are, where the answer is believed.
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


def parse(keys):
    header = laspy.LasHeader(point_format=1, version="1.2")
    directory = GeoKeyDirectoryVlr()
    rows = [(key, 0, 1, value) for key, value in keys]
    directory.parse_record_data(struct.pack(f"<{4 + 4 * len(rows)}H", 1, 1, 0, len(rows), *sum(rows, ())))
    header.vlrs.append(directory)
    crs = header.parse_crs()
    return crs.to_epsg(), crs.is_compound, crs.axis_info[0].unit_name


found = [parse([(1024, 1), (3072, 26910), extra]) for extra in ((4096, 6360), (4099, 9003), (3076, 9003))]
print(*found, sep="\n")
sys.exit(0 if found == [(26910, False, "metre")] * 3 else 1)
PY
