#!/usr/bin/env bash
# meshio 5.3.5 swaps corners of wedges in VTU files (1 with 2, 4 with 5), since VTK's page of vtkWedge says that the first
# triangle looks outwards. VTK 9.7 itself measures such a wedge as negative, and one whose first triangle looks inwards, as
# Gmsh's prism does, as positive: a positive wedge of a VTU file is inverted in what meshio makes of it.
# Seen: VTK's volumes 0.5 and -0.5; meshio's corners 0 2 1 3 5 4 of the positive one.
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet meshio==5.3.5 pyvista==0.49.1 vtk==9.7.2
cd "$folder"
venv/bin/python - <<'PYTHON'
import sys

import meshio
import numpy as np
import pyvista

points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], float)
inwards, outwards = [0, 1, 2, 3, 4, 5], [0, 2, 1, 3, 5, 4]
grids = [pyvista.UnstructuredGrid({13: np.array([corners])}, points) for corners in (inwards, outwards)]
volumes = [float(grid.compute_cell_sizes()["Volume"][0]) for grid in grids]
grids[0].save("wedge.vtu")
read = meshio.read("wedge.vtu").cells_dict["wedge"][0].tolist()
print(volumes, read)
sys.exit(volumes != [0.5, -0.5] or read != outwards)
PYTHON
