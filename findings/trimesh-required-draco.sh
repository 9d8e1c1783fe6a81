#!/usr/bin/env bash
# trimesh 5.2.0 without DracoPy does not refuse a glTF file that requires KHR_draco_mesh_compression, as glTF 2.0 asks of a
# reader that lacks a required extension (section 3.12). It returns a mesh of the right counts with every vertex at 0, 0, 0 and
# says so in the log alone. With DracoPy 2.2.0 installed the same file is read rightly.
# Seen: [[0, 0, 0], [0, 0, 0], [0, 0, 0]] without, [[0, 0, 0], [1, 0, 0], [0, 1, 0]] with it.
# Exits 1 if that changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
for name in with without; do
    python3 -m venv "$name"
    "$name/bin/pip" install --quiet trimesh==5.2.0
done
with/bin/pip install --quiet DracoPy==2.2.0
with/bin/python - <<'PYTHON'
import json
import struct

import DracoPy
import numpy as np

NAME = "KHR_draco_mesh_compression"
packed = DracoPy.encode(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]], np.uint32))
body = packed + bytes(-len(packed) % 4)
triangle = {
    "attributes": {"POSITION": 0},
    "indices": 1,
    "extensions": {NAME: {"bufferView": 0, "attributes": {"POSITION": 0}}},
}
scene = {
    "asset": {"version": "2.0"},
    "extensionsUsed": [NAME],
    "extensionsRequired": [NAME],
    "buffers": [{"byteLength": len(body)}],
    "bufferViews": [{"buffer": 0, "byteLength": len(packed)}],
    "accessors": [
        {"componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
        {"componentType": 5125, "count": 3, "type": "SCALAR"},
    ],
    "meshes": [{"primitives": [triangle]}],
    "nodes": [{"mesh": 0}],
    "scenes": [{"nodes": [0]}],
    "scene": 0,
}
text = json.dumps(scene).encode()
text += b" " * (-len(text) % 4)
chunks = [struct.pack("<II", len(part), kind) + part for part, kind in ((text, 0x4E4F534A), (body, 0x004E4942))]
size = 12 + sum(map(len, chunks))
with open("triangle.glb", "wb") as file:
    file.write(struct.pack("<III", 0x46546C67, 2, size) + b"".join(chunks))
PYTHON
read='
import trimesh
(mesh,) = trimesh.load("triangle.glb").geometry.values()
print(mesh.vertices.astype(int).tolist())
'
without=$(without/bin/python -c "$read" 2> /dev/null)
with=$(with/bin/python -c "$read" 2> /dev/null)
echo "without DracoPy: $without; with it: $with"
[ "$without" = "[[0, 0, 0], [0, 0, 0], [0, 0, 0]]" ]
[ "$with" = "[[0, 0, 0], [1, 0, 0], [0, 1, 0]]" ]
