#!/usr/bin/env bash
# libcitygml 2.4.3-1+b1 of Debian 12 (package libcitygml-bin): citygmltest calls the externalReference of a building, which is
# valid CityGML 2.0 and stands in most files of land registers, an error. It ends with 0 all the same, and its list of
# objects (-log) is empty with and without that reference, so it shows neither that a file is right nor that it was read.
# Seen: "with: 0, 1 errors, 0 objects", "without: 0, 0 errors, 0 objects".
# Exits 1 if that changes. Needs Debian 12, and rights to install packages.
set -euo pipefail
DEBIAN_FRONTEND=noninteractive apt-get install -y -qq libcitygml-bin=2.4.3-1+b1 > /dev/null
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
reference='<externalReference><informationSystem>http://example.org/register</informationSystem>
<externalObject><name>house 1</name></externalObject></externalReference>'
face() { echo "<gml:surfaceMember><gml:Polygon><gml:exterior><gml:LinearRing><gml:posList>$1</gml:posList></gml:LinearRing></gml:exterior></gml:Polygon></gml:surfaceMember>"; }
write() {
    echo '<CityModel xmlns="http://www.opengis.net/citygml/2.0" xmlns:bldg="http://www.opengis.net/citygml/building/2.0"
xmlns:gml="http://www.opengis.net/gml"><cityObjectMember><bldg:Building gml:id="house">'
    echo "$1"
    echo '<bldg:lod1Solid><gml:Solid srsName="EPSG:25833" srsDimension="3"><gml:exterior><gml:CompositeSurface>'
    face '0 0 0 0 9 0 9 9 0 9 0 0 0 0 0'
    face '0 0 3 9 0 3 9 9 3 0 9 3 0 0 3'
    face '0 0 0 9 0 0 9 0 3 0 0 3 0 0 0'
    face '9 0 0 9 9 0 9 9 3 9 0 3 9 0 0'
    face '9 9 0 0 9 0 0 9 3 9 9 3 9 9 0'
    face '0 9 0 0 0 0 0 0 3 0 9 3 0 9 0'
    echo '</gml:CompositeSurface></gml:exterior></gml:Solid></bldg:lod1Solid></bldg:Building></cityObjectMember></CityModel>'
}
look() {
    code=0
    citygmltest -log "$1.gml" > log 2>&1 || code=$?
    echo "$code, $(grep -c ^ERROR log || true) errors, $(sed '1,/^Objects hierarchy/d' log | grep -cv '^Done.$' || true) objects"
}
write "$reference" > with.gml
write "" > without.gml
with=$(look with)
without=$(look without)
echo "with: $with"
echo "without: $without"
[[ $with == "0, 1 errors, 0 objects" && $without == "0, 0 errors, 0 objects" ]]
