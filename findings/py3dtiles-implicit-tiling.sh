#!/usr/bin/env bash
# py3dtiles 12.1.1 reads a tileset of 3D Tiles 1.1 with implicit tiling without a warning and drops `implicitTiling`: what it writes
# is one explicit tile whose content is the template, with braces in its address, so all other tiles are lost.
# Seen: root keys boundingVolume, content, geometricError, refine; content "tiles/{level}/{x}/{y}.glb".
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet py3dtiles==12.1.1
"$folder/venv/bin/python" - <<'PYTHON'
import sys
import warnings

from py3dtiles.tileset import TileSet

template = "tiles/{level}/{x}/{y}.glb"
tiling = {
    "subdivisionScheme": "QUADTREE",
    "subtreeLevels": 2,
    "availableLevels": 2,
    "subtrees": {"uri": "subtrees/{level}/{x}/{y}.subtree"},
}
root = {
    "boundingVolume": {"box": [0, 0, 0, 50, 0, 0, 0, 50, 0, 0, 0, 10]},
    "geometricError": 50,
    "refine": "REPLACE",
    "content": {"uri": template},
    "implicitTiling": tiling,
}
with warnings.catch_warnings():
    warnings.simplefilter("error")
    given = {"asset": {"version": "1.1"}, "geometricError": 100, "root": root}
    found = TileSet.from_dict(given).to_dict()["root"]
print(sorted(found), found["content"]["uri"])
sys.exit("implicitTiling" in found or found["content"]["uri"] != template)
PYTHON
