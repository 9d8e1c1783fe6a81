#!/usr/bin/env bash
# pyogrio 0.13.0 (its wheel, GDAL 3.12.4): a CityGML file whose buildings are solids is read by GDAL's GML driver as a layer of
# PolyhedralSurface Z (1015). pyogrio knows no such type, and fails for the whole file: not only reading it, but listing its
# layers, reading the fields alone, and its Arrow stream, which hands WKB on as it is.
# Seen: "Geometry type is not supported: 1015" of list_layers, read_info, read with read_geometry=False, and read_arrow.
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyogrio==0.13.0 pyarrow==21.0.0
cd "$folder"
venv/bin/python - <<'PYTHON'
import sys
from functools import partial

import pyogrio

LOW, HIGH = "0 0 0 0 9 0 9 9 0 9 0 0 0 0 0", "0 0 3 9 0 3 9 9 3 0 9 3 0 0 3"
SIDES = [
    "0 0 0 9 0 0 9 0 3 0 0 3 0 0 0", "9 0 0 9 9 0 9 9 3 9 0 3 9 0 0",
    "9 9 0 0 9 0 0 9 3 9 9 3 9 9 0", "0 9 0 0 0 0 0 0 3 0 9 3 0 9 0",
]
faces = "".join(
    "<gml:surfaceMember><gml:Polygon><gml:exterior><gml:LinearRing><gml:posList>"
    f"{places}</gml:posList></gml:LinearRing></gml:exterior></gml:Polygon></gml:surfaceMember>"
    for places in [LOW, HIGH, *SIDES]
)
with open("house.gml", "w") as file:
    file.write(
        '<CityModel xmlns="http://www.opengis.net/citygml/2.0" xmlns:bldg="http://www.opengis.net/citygml/building/2.0"'
        ' xmlns:gml="http://www.opengis.net/gml"><cityObjectMember><bldg:Building gml:id="house"><bldg:lod1Solid>'
        f'<gml:Solid srsName="EPSG:25833" srsDimension="3"><gml:exterior><gml:CompositeSurface>{faces}'
        "</gml:CompositeSurface></gml:exterior></gml:Solid></bldg:lod1Solid></bldg:Building></cityObjectMember></CityModel>"
    )
tried = {
    "list_layers": pyogrio.list_layers,
    "read_info": pyogrio.read_info,
    "read": partial(pyogrio.raw.read, read_geometry=False),
    "read_arrow": pyogrio.raw.read_arrow,
}
said = {}
for name, function in tried.items():
    try:
        function("house.gml")
        said[name] = "read"
    except pyogrio.errors.GeometryError as error:
        said[name] = str(error)
    print(name, said[name])
sys.exit(0 if set(said.values()) == {"Geometry type is not supported: 1015"} else 1)
PYTHON
