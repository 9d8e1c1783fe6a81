"""What the specification of 3D Tiles (OGC 22-025r4) asks of the JSON that we write, as JSON schemas of our own.

They are narrower than those of the specification: members that we do not write are refused.
"""

from typing import Any

Schema = dict[str, Any]


def closed(**members: Schema) -> Schema:
    """An object with all of these members, those that end in ``_`` optional, and with no others."""
    named = {name.rstrip("_"): kind for name, kind in members.items()}
    needed = [name for name in members if not name.endswith("_")]
    return {"type": "object", "properties": named, "required": needed, "additionalProperties": False}


def some(kind: Schema) -> Schema:
    """An object whose members, of any names, are of a kind; at least one."""
    return {"type": "object", "minProperties": 1, "additionalProperties": kind}


def rows(kind: Schema, least: int = 1, most: int = 2**31) -> Schema:
    """An array of things of a kind."""
    return {"type": "array", "items": kind, "minItems": least, "maxItems": most}


INDEX, COUNT = {"type": "integer", "minimum": 0}, {"type": "integer", "minimum": 1}
NUMBER, TEXT = {"type": "number"}, {"type": "string", "minLength": 1}
NAME = {"type": "string", "pattern": "^[a-zA-Z_][a-zA-Z0-9_]*$"}
ERROR = NUMBER | {"minimum": 0}
BITS = {
    "anyOf": [
        closed(bitstream=INDEX, availableCount=INDEX),
        closed(constant={"enum": [0, 1]}, availableCount_=INDEX),
    ]
}
SCALAR: Schema = {"type": {"const": "SCALAR"}, "componentType": {"enum": ["FLOAT32", "FLOAT64"]}}
PROPERTY = {
    "anyOf": [
        closed(type={"const": "STRING"}, name_=TEXT),
        closed(**SCALAR, name_=TEXT, noData_=NUMBER, semantic_=TEXT),
        closed(**SCALAR, array={"const": True}, count={"type": "integer", "minimum": 2}, semantic_=TEXT),
    ]
}
CLASSES = closed(id=NAME, classes=some(closed(properties=some(PROPERTY))))
COLUMNS = some(closed(values=INDEX, stringOffsets_=INDEX))
MEMBERS: Schema = {"class": NAME, "count": COUNT, "properties": COLUMNS}
TABLE = closed(**MEMBERS)
TILING = closed(
    subdivisionScheme={"const": "QUADTREE"}, availableLevels=COUNT, subtreeLevels=COUNT, subtrees=closed(uri=TEXT)
)
ROOT = closed(
    boundingVolume=closed(region=rows(NUMBER, 6, 6)),
    geometricError=ERROR,
    refine={"const": "REPLACE"},
    content=closed(uri=TEXT),
    implicitTiling=TILING,
)
OWN = {
    "tileset": closed(
        asset=closed(version={"const": "1.1"}, generator=TEXT, extras={}),
        schema=CLASSES,
        geometricError=ERROR,
        root=ROOT,
    ),
    "Subtree/subtree": closed(
        tileAvailability=BITS,
        contentAvailability=rows(BITS, 1, 1),
        childSubtreeAvailability=BITS,
        propertyTables=rows(TABLE),
        tileMetadata=INDEX,
        buffers=rows(closed(byteLength=COUNT), 1, 1),
        bufferViews=rows(closed(buffer={"const": 0}, byteOffset=INDEX, byteLength=COUNT)),
    ),
    "Schema/schema": CLASSES,
    "PropertyTable/propertyTable": TABLE,
}
