#!/usr/bin/env bash
# VTK 9.7.2's reader of OpenFOAM turns a prism of a polyMesh into a wedge whose first triangle looks outwards. VTK itself
# measures the volume of such a wedge as negative, while the file's cell is positive by its owner's outward faces.
# Seen: corners 0 2 1 3 5 4, volume -0.5, of the prism over the triangle 0 1 2.
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pyvista==0.49.1 vtk==9.7.2
cd "$folder"
mkdir -p constant/polyMesh system
touch case.foam
write() {
    printf 'FoamFile\n{\n version 2.0;\n format ascii;\n class %s;\n object %s;\n}\n%s\n' "$1" "$(basename "$2")" "$3" > "$2"
}
write vectorField constant/polyMesh/points '6((0 0 0)(1 0 0)(0 1 0)(0 0 1)(1 0 1)(0 1 1))'
write faceList constant/polyMesh/faces '5(3(0 2 1)3(3 4 5)4(0 1 4 3)4(1 2 5 4)4(2 0 3 5))'
write labelList constant/polyMesh/owner '5(0 0 0 0 0)'
write labelList constant/polyMesh/neighbour '0()'
write polyBoundaryMesh constant/polyMesh/boundary '1(outside{type patch; nFaces 5; startFace 0;})'
write dictionary system/controlDict 'startFrom startTime; startTime 0; stopAt endTime; endTime 0; deltaT 1; writeInterval 1;'
venv/bin/python - <<'PYTHON'
import sys

import pyvista

mesh = pyvista.POpenFOAMReader("case.foam").read()["internalMesh"]
corners, volume = mesh.cells[1:].tolist(), float(mesh.compute_cell_sizes()["Volume"][0])
print(corners, volume)
sys.exit(corners != [0, 2, 1, 3, 5, 4] or volume != -0.5)
PYTHON
