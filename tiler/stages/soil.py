"""Soil below the columns of a tile: what the stage ``columns`` does with a depth for it (beyond the paper)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.nodes import Levels, SeamColumns, bare_levels, join_levels, take_columns
from pipeline.columns.underground import SoilOptions, add_soil, count_soil_cells
from pipeline.data.mesh import ColumnMesh, SeamEdges
from pipeline.data.notes import Note
from pipeline.plane_mesh.sizes import SizeField
from tiler.engine.task import Result, Task


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


def lay_soil(
    columns: ColumnMesh,
    terrain: NDArray[np.float64],
    edges: SeamEdges,
    shared: Sequence[NDArray[np.int32]],
    air: SeamColumns,
    soil: Sequence[Levels],
    options: SoilOptions,
    sizes: SizeField | None,
    task: Task,
) -> tuple[ColumnMesh, SeamEdges, int]:
    """Put a tile's columns of air on columns of soil.

    Parameters
    ----------
    columns : ColumnMesh
        The air.
    terrain : float64, (n,)
        Terrain at its vertices (m).
    edges : SeamEdges
        Its seams, with levels of the air.
    shared : sequence of int32, (k,)
        Vertices of each seam, and of each end of one that is given alone.
    air : SeamColumns
        Their columns of air, each once.
    soil : sequence of Levels
        Their columns of soil, in the order of `shared`.
    options : SoilOptions
        Parameters.
    sizes : SizeField, optional
        Sizes in the plane, where they are graded.
    task : Task
        The tile: gets the array ``soil``, and a note for each vertex at which terrain inside a house was lowered.

    Returns
    -------
    ColumnMesh
        Columns of both.
    SeamEdges
        The seams, with levels of these.
    int
        Cells of the soil.
    """
    vertex, first = np.unique(np.concatenate([np.empty(0, np.int32), *shared]), return_index=True)
    below = SeamColumns(vertex, take_columns(join_levels(soil), first.astype(np.int32)))
    mesh, raised, lowered = add_soil(columns, terrain, air, below, options, sizes=sizes)
    for x, y in columns.plane.xy[lowered].tolist():
        task.note(
            Note("soil-lowered-under-roof", task.name, x, y, "the terrain inside the house reaches its roof")
        )
    task.put(soil=mesh.top)
    moved = replace(edges, bottom=edges.bottom + raised[edges.vertices])
    return mesh.columns, moved, count_soil_cells(mesh)
