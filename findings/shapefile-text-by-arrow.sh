#!/usr/bin/env bash
# pyogrio 0.13.0 (wheel, with GDAL 3.12.4), pyarrow 26.0.1: a Shapefile without a .cpg and without a language driver in its
# table (as many programs leave it) has Latin-1 text by GDAL's rule. raw.read gives that text; raw.open_arrow gives the stored
# bytes in a column of type string, which is no UTF-8, so that the first look at a value raises UnicodeDecodeError.
# Casting the column to binary gives the bytes.
# Seen: "read: Straße", "open_arrow: UnicodeDecodeError", "as binary: b'Stra\xdfe'".
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyogrio==0.13.0 numpy==2.4.6 shapely==2.2.0 pyarrow==26.0.1
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import pathlib
import sys

import numpy as np
import pyarrow as pa
import pyogrio
import shapely

house = np.array([shapely.to_wkb(shapely.box(0, 0, 9, 9))], object)
name = np.array(["Straße"], object)
options = {"geometry_type": "Polygon", "crs": "EPSG:28992", "driver": "ESRI Shapefile", "encoding": "ISO-8859-1"}
pyogrio.raw.write("a.shp", house, [name], ["street"], **options)
pathlib.Path("a.cpg").unlink(missing_ok=True)
table = bytearray(pathlib.Path("a.dbf").read_bytes())
table[29] = 0  # language driver: not stated
pathlib.Path("a.dbf").write_bytes(table)
read = pyogrio.raw.read("a.shp")[3][0][0]
with pyogrio.raw.open_arrow("a.shp", use_pyarrow=True) as (_, reader):
    column = reader.read_all().column(0)
try:
    streamed = column.to_pylist()[0]
except UnicodeDecodeError as error:
    streamed = type(error).__name__
stored = column.cast(pa.binary()).to_pylist()[0]
print("read:", read, "| open_arrow:", streamed, "| as binary:", stored)
same = (read, streamed, stored) == ("Straße", "UnicodeDecodeError", b"Stra\xdfe")
sys.exit(0 if same and pa.types.is_string(column.type) else 1)
PYTHON
