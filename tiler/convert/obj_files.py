"""Wavefront OBJ of buildings: an object each, with a group for each kind of face."""

from pathlib import Path

from tiler.cityinput.faces import UNKNOWN
from tiler.convert.features import SURFACES
from tiler.convert.inputs import ModelSource
from tiler.convert.triangles import iter_triangles
from tiler.export.pieces import write_lines

GROUPS = {UNKNOWN: "surface"} | {kind: name.removesuffix("Surface").lower() for kind, name in SURFACES.items()}


def write_obj(path: Path, source: ModelSource, lod: str) -> None:
    """Write triangles of one level of detail; ids are kept, attributes have no place."""
    n = 1
    with path.open("wb") as file:
        file.write(b"# x east, y north, z up\n")
        for one in iter_triangles(source, lod):
            file.write(f"o {' '.join(one.id.split())}\n".encode())
            write_lines(file, "v %.3f %.3f %.3f\n", one.xyz)
            for kind, name in GROUPS.items():
                if (one.kind == kind).any():
                    file.write(f"g {name}\n".encode())
                    write_lines(file, "f %d %d %d\n", one.triangles[one.kind == kind] + n)
            n += len(one.xyz)
