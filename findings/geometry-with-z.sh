#!/usr/bin/env bash
# pyogrio 0.13.0 (wheel, with GDAL 3.12.4): list_layers, read_info and raw.read all raise GeometryError for
# a GeoPackage whose layer is of the type GEOMETRY with Z mandatory, though each feature is an ordinary Polygon Z.
# The type with Z optional (z = 2) is read. A VRT that states no type for the same layer is read, and gives the polygon.
# Seen: "z=1: GeometryError: Geometry type is not supported: 2147483648", "z=2: 1 feature", "z=1 by a VRT: 1 feature".
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyogrio==0.13.0 numpy==2.4.6 shapely==2.2.0
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sqlite3
import sys

import numpy as np
import pyogrio
import shapely

house = np.array([shapely.to_wkb(shapely.force_3d(shapely.box(0, 0, 9, 9), 2.0), flavor="iso")], object)
found = {}
for z in (1, 2):
    path = f"z{z}.gpkg"
    pyogrio.raw.write(path, house, [np.array(["a"], object)], ["id"], layer="b", geometry_type="Unknown", crs="EPSG:28992")
    with sqlite3.connect(path) as database:
        database.execute("UPDATE gpkg_geometry_columns SET geometry_type_name = 'GEOMETRY', z = ?", (z,))
    database.close()
    for call in (pyogrio.list_layers, pyogrio.read_info, pyogrio.raw.read):
        try:
            call(path)
            found[z, call.__name__] = "read"
        except pyogrio.errors.GeometryError as error:
            found[z, call.__name__] = f"GeometryError: {error}"
vrt = (
    '<OGRVRTDataSource><OGRVRTLayer name="b"><SrcDataSource>z1.gpkg</SrcDataSource>'
    "<GeometryType>wkbUnknown</GeometryType></OGRVRTLayer></OGRVRTDataSource>"
)
open("z1.vrt", "w").write(vrt)
n = len(pyogrio.raw.read("z1.vrt")[2])
for key, text in found.items():
    print(*key, text)
print("z=1 by a VRT:", n, "feature")
refused = all(text.startswith("GeometryError") == (z == 1) for (z, _), text in found.items())
sys.exit(0 if refused and n == 1 else 1)
PYTHON
