#!/usr/bin/env bash
# shapely-polyskel 0.1.2: a square of 12 m with a square courtyard of 4 m in its middle. Near the origin its straight
# skeleton has four nodes at the height 2. The same shape moved to (400000, 5000000), as in UTM, gets one node at the
# height 6, in the middle of the courtyard: the skeleton of the square without it. No error, no warning.
# Seen: "at the origin: heights [2.0, 2.0, 2.0, 2.0]", "moved by whole metres: heights [6.0]".
# Exit 0: as described. Exit 1: it behaves otherwise now.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet shapely-polyskel==0.1.2 shapely==2.2.0 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import shapely
from shapely import affinity
from shapely_polyskel import StraightSkeleton

square = shapely.Polygon(shapely.box(0, 0, 12, 12).exterior, [shapely.box(4, 4, 8, 8).exterior])
moved = affinity.translate(square, 400_000, 5_000_000)
heights = [[node.height for node in StraightSkeleton(polygon).straight_skeleton] for polygon in (square, moved)]
print("at the origin: heights", heights[0])
print("moved by whole metres: heights", heights[1])
sys.exit(0 if heights == [[2.0] * 4, [6.0]] else 1)
PYTHON
