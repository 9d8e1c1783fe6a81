"""What all glTF files of ours share: numbers of types, colours of materials, the frame of a binary file."""

import struct
from typing import Any

from pipeline.data.mesh import GROUND_PATCHES, Marker

BYTE, FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5120, 5126, 5123, 5125
VERTICES, INDICES = 34962, 34963  # targets of buffer views
MOST_BYTES = 2**32 - 1  # of a GLB file: its length has 32 bits
EARTH = (0.42, 0.33, 0.24)
COLOURS = {
    Marker.GROUND: (0.45, 0.5, 0.38),
    Marker.WALL: (0.82, 0.78, 0.7),
    Marker.ROOF: (0.66, 0.33, 0.25),
    Marker.BOTTOM: EARTH,
    Marker.FOUNDATION: EARTH,
}
GROUND_COLOURS = {
    "ground_water": (0.3, 0.46, 0.62),
    "ground_street": (0.42, 0.42, 0.43),
    "ground_rail": (0.5, 0.44, 0.4),
    "ground_sand": (0.8, 0.74, 0.58),
    "ground_forest": (0.2, 0.36, 0.2),
    "ground_scrub": (0.4, 0.48, 0.28),
    "ground_grass": (0.47, 0.62, 0.35),
    "ground_field": (0.68, 0.64, 0.4),
}
CELLS = 20  # material of slices: no marker of a facet
CELLS_COLOUR = (0.85, 0.6, 0.2)
SIDE_COLOUR, SIDE_OPACITY = (0.6, 0.75, 0.9), 0.1  # of top and sides, through which the city is seen


def make_material(marker: int, name: str) -> dict[str, Any]:
    """Colour a patch; its back is what one sees from the air."""
    colours = {int(key): colour for key, colour in COLOURS.items()} | {CELLS: CELLS_COLOUR}
    if marker > GROUND_PATCHES:
        colours[marker] = GROUND_COLOURS.get(name, COLOURS[Marker.GROUND])
    known = colours.get(marker)
    solid = known is not None
    colour = [*(known or SIDE_COLOUR), 1.0 if solid else SIDE_OPACITY]
    surface = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = {"name": name, "pbrMetallicRoughness": surface, "doubleSided": True}
    return material if solid else material | {"alphaMode": "BLEND"}


def begin_glb(text: bytes, data: int) -> bytes:
    """Give what comes before the buffer of a GLB file: header, padded document, and the head of its chunk."""
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + data)
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", data, b"BIN\0")
