#!/usr/bin/env bash
# pyogrio 0.13.0 (its GDAL brings PROJ's register of EPSG v12) and pyproj 3.7.2 (an older register): a layer in
# EPSG:10979 is written and read by one, and its CRS, given as "EPSG:10979", cannot be parsed by the other.
# The WKT that the GeoPackage itself holds can be parsed by both.
# Seen: "pyogrio: EPSG:10979", "pyproj: CRSError", "its WKT: NATRF2022 / Gulf".
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check pyogrio==0.13.0 pyproj==3.7.2 shapely==2.1.2
"$work/venv/bin/python" - "$work/layer.gpkg" <<'PYTHON'
import sqlite3
import sys

import numpy as np
import pyogrio
import pyproj
import shapely

path = sys.argv[1]
geometry = shapely.to_wkb(np.array([shapely.box(0, 0, 10, 10)], object))
pyogrio.raw.write(path, geometry, [np.array([1])], ["id"], geometry_type="Polygon", crs="EPSG:10979")
stated = pyogrio.read_info(path)["crs"]
print("pyogrio:", stated)
try:
    parsed = pyproj.CRS(stated).name
except pyproj.exceptions.CRSError as error:
    parsed = type(error).__name__
print("pyproj:", parsed)
(wkt,) = sqlite3.connect(path).execute("select definition from gpkg_spatial_ref_sys where srs_id = 10979").fetchone()
name = pyproj.CRS(wkt).name
print("its WKT:", name)
sys.exit(0 if (stated, parsed) == ("EPSG:10979", "CRSError") and "NATRF2022" in name else 1)
PYTHON
