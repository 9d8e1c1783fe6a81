"""Surfaces in files of any format by the name of their patch, and what they must hold."""

import json
import struct
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from pipeline.data.mesh import Marker
from tests.helpers.vtk_readers import read_vtk
from tiler.export.foam_patches import HOUSE, PATCHES, building_name

Corners = NDArray[np.float64]  # (n, 3, 3) of facets, (n, 4, 3) of cells
Patches = dict[str, Corners]
INTERNAL = "Internal"  # the cells


def patch_of(marker: int, building: int) -> str:
    """Name of a facet's patch where each building has its own."""
    return building_name(building) if building >= 0 and marker in HOUSE else PATCHES[Marker(marker)]


def corners_of(pieces: Any, name_of: Callable[[int, int], str]) -> Patches:
    """Cells of pieces, and facets by a name that their marker and building have."""
    parts = [pieces.read(k) for k in range(len(pieces.names))]
    found: dict[str, list[Corners]] = {INTERNAL: [part.points[part.cells] for part in parts]}
    for part in parts:
        for marker, building in np.unique(np.stack((part.marker, part.building)), axis=1).T.tolist():
            rows = (part.marker == marker) & (part.building == building)
            found.setdefault(name_of(marker, building), []).append(part.points[part.facets[rows]])
    return {name: np.concatenate(rows) for name, rows in found.items()}


def expected_of(pieces: Any, path: Path, name: str, *, by_building: bool = False) -> Patches:
    """What a file of pieces must hold: CGNS alone has cells, PLY the building of each facet."""
    if name == "ply":
        found = corners_of(pieces, lambda marker, building: f"{PATCHES[Marker(marker)]} of {building}")
    else:
        found = corners_of(pieces, patch_of if by_building else lambda marker, _: PATCHES[Marker(marker)])
    if name != "cgns":
        del found[INTERNAL]
    if name == "glb":
        origin = read_document(path)[0]["asset"]["extras"]["origin"]
        return {patch: turned(corners, origin) for patch, corners in found.items()}
    return found


def read_stl(path: Path) -> Patches:
    found: dict[str, list[list[float]]] = {}
    name = ""
    for words in map(str.split, path.read_text().splitlines()):
        if words[0] == "solid":
            name = words[1]
            assert name not in found
            found[name] = []
        elif words[0] == "endsolid":
            assert words[1] == name
        elif words[0] == "vertex":
            found[name].append([float(word) for word in words[1:]])
    return {name: np.array(rows).reshape(-1, 3, 3) for name, rows in found.items()}


def read_obj(path: Path) -> Patches:
    points: list[tuple[float, ...]] = []
    found: dict[str, list[list[int]]] = {}
    name = ""
    for words in map(str.split, path.read_text().splitlines()):
        if words[0] == "g":
            name = words[1]
        elif words[0] == "v":
            points.append(tuple(float(word) for word in words[1:]))
        elif words[0] == "f":
            found.setdefault(name, []).append([int(word) - 1 for word in words[1:]])
    assert sorted({node for rows in found.values() for row in rows for node in row}) == list(range(len(points)))
    assert len(set(points)) == len(points)
    return {name: np.array(points)[np.array(rows)] for name, rows in found.items()}


def read_ply(path: Path) -> Patches:
    """Read it as its header says, by building; meshio takes no file with lists and numbers in one element."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    kinds = {"double": "<f8", "int": "<i4", "uchar": "u1"}
    elements: dict[str, tuple[int, list[Any]]] = {}
    for words in map(str.split, head.decode().splitlines()):
        if words[0] == "element":
            fields: list[Any] = []
            elements[words[1]] = int(words[2]), fields
        elif words[:2] == ["property", "list"]:
            fields += [("n", kinds[words[2]]), (words[4], kinds[words[3]], 3)]
        elif words[0] == "property":
            fields.append((words[2], kinds[words[1]]))
    points, faces = (np.dtype(elements[name][1]) for name in ("vertex", "face"))
    n = elements["vertex"][0]
    vertex = np.frombuffer(body, points, n)
    face = np.frombuffer(body[n * points.itemsize :], faces)
    assert len(face) == elements["face"][0]
    assert (face["n"] == 3).all()
    xyz = np.column_stack([vertex[axis] for axis in "xyz"])
    assert np.array_equal(np.unique(face["vertex_indices"]), np.arange(n))
    assert len(np.unique(xyz, axis=0)) == n
    marker, building = face["marker"].astype(np.int64), face["building"].astype(np.int64)
    return {
        f"{PATCHES[Marker(m)]} of {b}": xyz[face["vertex_indices"][(marker == m) & (building == b)]]
        for m, b in np.unique(np.stack((marker, building)), axis=1).T.tolist()
    }


def read_msh(path: Path) -> Patches:
    mesh = meshio.read(path)
    names = {(tag, dimension): name for name, (tag, dimension) in mesh.field_data.items()}
    found: dict[str, list[Corners]] = {}
    for block, groups in zip(mesh.cells, mesh.cell_data["gmsh:physical"], strict=True):
        for tag in np.unique(groups).tolist() if block.type == "triangle" else []:
            found.setdefault(names[tag, 2], []).append(mesh.points[block.data[groups == tag]])
    return {name: np.concatenate(rows) for name, rows in found.items()}


def read_document(path: Path) -> tuple[dict[str, Any], Callable[[int], NDArray[Any]]]:
    """Read the document of a GLB file, and give what takes the numbers of an accessor."""
    data = path.read_bytes()
    magic, version, total, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, total, size % 4, kind) == (b"glTF", 2, len(data), 0, b"JSON")
    document = json.loads(data[20 : 20 + size])
    length, kind = struct.unpack_from("<I4s", data, 20 + size)
    body = data[28 + size :]
    assert (length, kind, document["buffers"]) == (len(body), b"BIN\0", [{"byteLength": len(body)}])
    vectors = Counter(one["bufferView"] for one in document["accessors"] if one["type"] != "SCALAR")
    assert all(n == 1 or "byteStride" in document["bufferViews"][view] for view, n in vectors.items())
    dtypes, widths = {5126: "<f4", 5125: "<u4"}, {"SCALAR": 1, "VEC2": 2, "VEC3": 3}

    def take(k: int) -> NDArray[Any]:
        accessor = document["accessors"][k]
        dtype, width = dtypes[accessor["componentType"]], widths[accessor["type"]]
        view = document["bufferViews"][accessor["bufferView"]]
        start, n = accessor.get("byteOffset", 0), width * accessor["count"]
        assert view.get("byteStride", 4 * width) == 4 * width
        assert start + 4 * n <= view["byteLength"]
        return np.frombuffer(body, dtype, n, view.get("byteOffset", 0) + start)

    return document, take


def read_glb(path: Path) -> Patches:
    """Triangles of each building, and of each material of nodes that are none."""
    document, take = read_document(path)
    found: dict[str, list[Corners]] = {}
    assert document["scenes"] == [{"nodes": list(range(len(document["nodes"])))}]
    assert len({node["name"] for node in document["nodes"]}) == len(document["nodes"])
    for node in document["nodes"]:
        mesh = document["meshes"][node["mesh"]]
        assert mesh["name"] == node["name"]
        for primitive in mesh["primitives"]:
            name = material = document["materials"][primitive["material"]]["name"]
            points = take(primitive["attributes"]["POSITION"]).reshape(-1, 3).astype(np.float64)
            rows = take(primitive["indices"]).reshape(-1, 3)
            if node["name"] != "boundary":  # a node a patch, with vertices of its own
                assert len(mesh["primitives"]) == 1
                assert np.array_equal(np.unique(rows), np.arange(len(points)))
                assert not node["name"][-1].isdecimal()
            if "building" in node.get("extras", {}):
                name = building_name(node["extras"]["building"])
                assert material == {Marker.WALL: "walls", Marker.ROOF: "roofs"}[primitive["extras"]["marker"]]
                assert node["name"] == f"{name}_{material}"
            found.setdefault(name, []).append(points[rows])
    return {name: np.concatenate(rows) for name, rows in found.items()}


def turned(points: Corners, origin: list[float]) -> Corners:
    """Coordinates as glTF has them: east, up, south of the origin, in single precision."""
    east, north, up = np.moveaxis(points - origin, -1, 0)
    return np.stack((east, up, -north), axis=-1).astype(np.float32).astype(np.float64)


def read_cgns(path: Path) -> Patches:
    """Cells and patches, as ParaView's reader has them."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOCGNSReader import vtkCGNSReader

    reader = vtkCGNSReader()

    def take_all() -> None:
        reader.UpdateInformation()
        reader.EnableAllBases()
        reader.EnableAllFamilies()
        reader.LoadBndPatchOn()

    found: Patches = {}

    def collect(blocks: Any) -> None:
        for i in range(blocks.GetNumberOfBlocks()):
            block, name = blocks.GetBlock(i), blocks.GetMetaData(i).Get(blocks.NAME())
            if block.IsA("vtkMultiBlockDataSet"):
                collect(block)
                continue
            nodes = vtk_to_numpy(block.GetCells().GetConnectivityArray())
            width = 4 if name == INTERNAL else 3
            assert {block.GetCellType(j) for j in range(block.GetNumberOfCells())} == {10 if width == 4 else 5}
            found[name] = vtk_to_numpy(block.GetPoints().GetData())[nodes].reshape(-1, width, 3)

    collect(read_vtk(reader, path, take_all).GetOutput())
    return found


READERS: dict[str, Callable[[Path], Patches]] = {
    "stl": read_stl,
    "obj": read_obj,
    "ply": read_ply,
    "glb": read_glb,
    "msh": read_msh,
    "msh2": read_msh,
    "cgns": read_cgns,
}


def sorted_rows(corners: Corners) -> list[list[float]]:
    return sorted(corners.reshape(len(corners), -1).tolist())


def assert_same_patches(found: Patches, expected: Patches) -> None:
    assert sorted(found) == sorted(expected)
    for patch, corners in expected.items():
        assert sorted_rows(found[patch]) == sorted_rows(corners), patch


def surface_of(patches: Patches) -> Corners:
    return np.concatenate([corners for name, corners in patches.items() if name != INTERNAL])


def open_edges(corners: Corners) -> int:
    """Count directed edges of facets that the other direction does not answer as often."""
    _, corner = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    node = corner.reshape(-1, 3)
    edges = np.concatenate([node[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    backwards = edges[:, 0] > edges[:, 1]
    _, edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    return int(np.count_nonzero(np.bincount(edge.ravel(), np.where(backwards, -1, 1))))


def volume(corners: Corners) -> float:
    """Volume within a closed surface."""
    a, b, c = np.moveaxis(corners - corners.reshape(-1, 3).mean(axis=0), 1, 0)
    return float(np.einsum("ij,ij->", np.cross(a, b), c)) / 6


def volume_of_cells(corners: Corners) -> float:
    a, b, c, d = np.moveaxis(corners, 1, 0)
    return float(np.einsum("ij,ij->", np.cross(b - a, c - a), d - a)) / 6
