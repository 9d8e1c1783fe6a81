"""Seams and columns as arrays of the store, and back."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.nodes import Levels, Surfaces, bare_levels
from pipeline.data.mesh import ColumnMesh, PlaneMesh
from stitch.seams.seams import Seam
from tiler.engine.task import Result

NO_PLANE = PlaneMesh(np.empty((0, 2)), np.empty((0, 3), np.int32), np.empty(0, np.int32))


def pack_seam(seam: Seam, numbers: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Write a seam as arrays; buildings go by their numbers."""
    return {
        "xy": seam.xy,
        "wall_nodes": seam.wall_nodes,
        "border": np.array([seam.border]),
        "ring_xy": seam.ring.xy,
        "ring_triangles": seam.ring.triangles,
        "ring_building": np.append(numbers, -1)[seam.ring.building],
        "vertex": seam.vertex,
    }


def unpack_seam(arrays: dict[str, NDArray[Any]], numbers: NDArray[np.int64]) -> Seam:
    """Read what `pack_seam` wrote, for a city model with these numbers; its surroundings are not kept."""
    row = _find_rows(numbers, arrays["ring_building"]).astype(np.int32)
    ring = PlaneMesh(arrays["ring_xy"], arrays["ring_triangles"], row)
    return Seam(arrays["xy"], arrays["wall_nodes"], bool(arrays["border"][0]), ring, arrays["vertex"], NO_PLANE)


def pack_levels(levels: Levels, numbers: NDArray[np.int64], name: str) -> dict[str, NDArray[Any]]:
    """Write columns of a seam or a corner as arrays; buildings go by their numbers; keys only if they differ."""
    surfaces = levels.surfaces
    return {
        f"{name}_key": np.empty(0) if np.array_equal(levels.key, levels.z) else levels.key,
        f"{name}_start": levels.start,
        f"{name}_z": levels.z,
        f"{name}_kind": levels.kind,
        f"{name}_surface_start": surfaces.start,
        f"{name}_surface_building": np.append(numbers, -1)[surfaces.building],
        f"{name}_surface_level": surfaces.level,
    }


def unpack_levels(arrays: dict[str, NDArray[Any]], numbers: NDArray[np.int64], name: str) -> Levels:
    """Read what `pack_levels` wrote, for a city model with these numbers."""
    building = _find_rows(numbers, arrays[f"{name}_surface_building"])
    start, level = arrays[f"{name}_surface_start"], arrays[f"{name}_surface_level"]
    column = np.repeat(np.arange(len(start) - 1), np.diff(start))
    order = np.lexsort((building, column))
    return Levels(
        arrays[f"{name}_start"],
        arrays[f"{name}_z"],
        arrays[f"{name}_kind"],
        arrays[f"{name}_key"] if len(arrays[f"{name}_key"]) else arrays[f"{name}_z"],
        Surfaces(start, building[order], level[order]),
    )


def unpack_pinched(seam: Seam, result: Result, numbers: NDArray[np.int64]) -> list[tuple[Seam, Levels]]:
    """Read the columns of the ends of a border in which two tiles meet alone, each as a seam of one vertex."""
    return [
        (dataclasses.replace(seam, xy=seam.xy[[-k]]), unpack_levels(result.arrays, numbers, f"end{k}"))
        for k in result.facts.get("pinched", [])
    ]


def _find_rows(numbers: NDArray[np.int64], building: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of buildings in a city model with these numbers; -1 stays."""
    order = np.argsort(numbers)
    row = np.full(len(building), -1, np.int64)
    inside = building >= 0
    row[inside] = order[np.searchsorted(numbers, building[inside], sorter=order)]
    return row


def pack_columns(mesh: ColumnMesh, numbers: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Write columns as arrays; buildings go by their numbers."""
    plane = mesh.plane
    return {
        "key": np.empty(0) if mesh.key is None else mesh.key,
        "moved": np.empty(0) if mesh.moved is None else mesh.moved,
        "xy": plane.xy,
        "triangles": plane.triangles,
        "building": np.append(numbers, -1)[plane.building],
        "z_start": mesh.z_start,
        "z": mesh.z,
        "bottom": mesh.bottom,
    }


def unpack_soil(arrays: dict[str, NDArray[Any]]) -> Levels:
    """Read the columns of soil of a seam within the region."""
    return bare_levels(arrays["soil_start"], arrays["soil_z"])


def unpack_pinched_soil(result: Result) -> list[Levels]:
    """Read the columns of soil of the ends of a border in which two tiles meet alone, as `unpack_pinched` does."""
    arrays = result.arrays
    return [
        bare_levels(arrays[f"end{k}_soil_start"], arrays[f"end{k}_soil_z"])
        for k in result.facts.get("pinched", [])
    ]
