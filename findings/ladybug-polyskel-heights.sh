#!/usr/bin/env bash
# ladybug-geometry-polyskel 1.7.55: straight skeleton of a T, its wings 4 m wide. All its nodes are 2 m from the edges
# that meet there; the places of nodes are right. The height of the node where a vertex that points inwards runs into
# an edge is its distance from that vertex, 2.83, so a roof made of these heights has no plane boards.
# Seen: "(2.0, 2.0) 2.0", "(6.0, 10.0) 2.0", "(10.0, 2.0) 2.0", "(6.0, 2.0) 2.8284271247461903".
# Exit 0: as described. Exit 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet ladybug-geometry-polyskel==1.7.55 ladybug-geometry==1.35.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

from ladybug_geometry.geometry2d import Point2D, Polygon2D
from ladybug_geometry_polyskel.polyskel import skeleton_as_subtree_list

corners = [(0, 0), (12, 0), (12, 4), (8, 4), (8, 12), (4, 12), (4, 4), (0, 4)]
nodes = skeleton_as_subtree_list(Polygon2D([Point2D(x, y) for x, y in corners]), None, 1e-5)
found = {(round(node.source.x, 6), round(node.source.y, 6)): node.height for node in nodes}
for place, height in found.items():
    print(place, height)
others = [height for place, height in found.items() if place != (6.0, 2.0)]
seen = others == [2.0] * 3 and abs(found[6.0, 2.0] - 8**0.5) < 1e-9
sys.exit(0 if seen else 1)
PYTHON
