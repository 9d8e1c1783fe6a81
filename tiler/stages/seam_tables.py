"""Seams and columns as arrays of the store, and back."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.nodes import Levels
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
    order = np.argsort(numbers)
    building = arrays["ring_building"]
    row = np.full(len(building), -1, np.int32)
    inside = building >= 0
    row[inside] = order[np.searchsorted(numbers, building[inside], sorter=order)]
    ring = PlaneMesh(arrays["ring_xy"], arrays["ring_triangles"], row)
    return Seam(arrays["xy"], arrays["wall_nodes"], bool(arrays["border"][0]), ring, arrays["vertex"], NO_PLANE)


def unpack_levels(arrays: dict[str, NDArray[Any]]) -> Levels:
    """Read the columns of a seam within the region."""
    return Levels(arrays["level_start"], arrays["level_z"], arrays["level_surface"])


def unpack_pinched(seam: Seam, result: Result) -> list[tuple[Seam, Levels]]:
    """Read the columns of the ends of a border in which two tiles meet alone, each as a seam of one vertex."""
    arrays = result.arrays
    return [
        (
            dataclasses.replace(seam, xy=seam.xy[[-k]]),
            Levels(arrays[f"end{k}_start"], arrays[f"end{k}_z"], arrays[f"end{k}_surface"]),
        )
        for k in result.facts.get("pinched", [])
    ]


def pack_columns(mesh: ColumnMesh, numbers: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Write columns as arrays; buildings go by their numbers."""
    plane = mesh.plane
    return {
        "xy": plane.xy,
        "triangles": plane.triangles,
        "building": np.append(numbers, -1)[plane.building],
        "z_start": mesh.z_start,
        "z": mesh.z,
        "bottom": mesh.bottom,
    }
