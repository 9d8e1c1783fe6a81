#!/usr/bin/env bash
# laspy 2.7.0 with lazrs 0.8.2: a sound COPC file of several chunks of different sizes is read from its start with the
# right points; after LasReader.seek to the first point of a chunk, most chunks give other points without an error.
# Seen: "from the start: right", "error: IoError: failed to fill whole buffer" (one chunk), "after seek: other points
# in 2 of 4 chunks".
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check laspy==2.7.0 lazrs==0.8.2 copclib==2.6.3 numpy==2.4.6
"$work/venv/bin/python" - "$work/cloud.copc.laz" <<'PYTHON'
import sys

import copclib
import laspy
import numpy as np

path = sys.argv[1]
config = copclib.CopcConfigWriter(6, (0.01, 0.01, 0.01), (0.0, 0.0, 0.0))
config.las_header.min, config.las_header.max = copclib.Vector3(0, 0, 0), copclib.Vector3(100, 100, 100)
writer = copclib.FileWriter(path, config)
rng = np.random.default_rng(1)
counts = [500, 40, 300, 7]
keys = [(0, 0, 0, 0), (1, 0, 0, 0), (1, 1, 0, 0), (1, 0, 1, 0)]
for key, count in zip(keys, counts):
    points = copclib.Points(config.las_header)
    for x, y, z in rng.uniform(0, 100, (count, 3)).round(2):
        point = points.CreatePoint()
        point.x, point.y, point.z = x, y, z
        points.AddPoint(point)
    writer.AddNode(copclib.VoxelKey(*key), points)
writer.Close()

with laspy.open(path) as reader:
    expected = reader.read_points(sum(counts)).array
print("from the start:", "right" if len(expected) == sum(counts) else "wrong")
others = 0
for first, count in zip(np.cumsum([0, *counts[:-1]]).tolist(), counts):
    with laspy.open(path) as reader:
        reader.seek(first)
        try:
            found = reader.read_points(count).array
            others += not np.array_equal(found, expected[first : first + count])
        except Exception as error:
            print("error:", error)
print(f"after seek: other points in {others} of {len(counts)} chunks")
sys.exit(0 if others else 1)
PYTHON
