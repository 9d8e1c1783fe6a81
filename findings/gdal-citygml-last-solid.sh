#!/usr/bin/env bash
# fiona 1.10.1 (GDAL inside) reads a CityGML 2.0 building of two parts, each a solid of its own, as one feature with the faces of
# the last part alone: half of the house is gone, without a warning.
# Seen: one feature, MultiPolygon, 6 faces of 12, all of the second part (x from 20).
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet fiona==1.10.1
"$folder/venv/bin/python" - "$folder/house.gml" <<'PYTHON'
import sys

import fiona

FACES = ("0123", "4765", "0451", "1562", "2673", "3740")


def solid(x):
    corners = [(x + i, j, k) for k in (0, 3) for i, j in ((0, 0), (0, 10), (10, 10), (10, 0))]
    faces = ""
    for face in FACES:
        ring = [corners[int(n)] for n in face + face[0]]
        numbers = " ".join(f"{value}" for point in ring for value in point)
        faces += (
            "<gml:surfaceMember><gml:Polygon><gml:exterior><gml:LinearRing>"
            f"<gml:posList srsDimension='3'>{numbers}</gml:posList>"
            "</gml:LinearRing></gml:exterior></gml:Polygon></gml:surfaceMember>"
        )
    return (
        "<bldg:lod2Solid><gml:Solid><gml:exterior><gml:CompositeSurface>"
        f"{faces}</gml:CompositeSurface></gml:exterior></gml:Solid></bldg:lod2Solid>"
    )


parts = "".join(
    f"<bldg:consistsOfBuildingPart><bldg:BuildingPart gml:id='p{x}'>{solid(x)}"
    "</bldg:BuildingPart></bldg:consistsOfBuildingPart>"
    for x in (0, 20)
)
with open(sys.argv[1], "w") as file:
    file.write(
        "<?xml version='1.0' encoding='UTF-8'?>"
        "<core:CityModel xmlns:core='http://www.opengis.net/citygml/2.0' xmlns:gml='http://www.opengis.net/gml' "
        "xmlns:bldg='http://www.opengis.net/citygml/building/2.0'>"
        "<gml:boundedBy><gml:Envelope srsName='EPSG:25832' srsDimension='3'><gml:lowerCorner>0 0 0</gml:lowerCorner>"
        "<gml:upperCorner>30 10 3</gml:upperCorner></gml:Envelope></gml:boundedBy>"
        f"<core:cityObjectMember><bldg:Building gml:id='b'>{parts}</bldg:Building></core:cityObjectMember>"
        "</core:CityModel>"
    )
found = []
for layer in fiona.listlayers(sys.argv[1]):
    with fiona.open(sys.argv[1], layer=layer) as source:
        for feature in source:
            faces = feature.geometry.coordinates
            least = min(x for face in faces for ring in face for x, *_ in ring)
            found.append((feature.geometry.type, len(faces), least))
print(found)
sys.exit(found != [("MultiPolygon", 6, 20.0)])
PYTHON
