"""Run folders of tiled cities, written from tiles that were meshed alone."""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.columns.adaptive import AdaptiveOptions
from pipeline.columns.cell_blocks import CellBlocks, UsedPoints, number_used
from pipeline.columns.columns import find_used_points, split_boundary
from pipeline.data.mesh import Boundary, ColumnMesh, SeamEdges, TetMesh
from pipeline.points_terrain.terrain import Dtm, sample_dtm
from stitch.pieces.numbering import count_all_points, count_by_part, first_id, number_columns, seam_ids, tile_part
from stitch.seams.facets import Side, find_seam_edges
from stitch.seams.seam_columns import tile_columns
from stitch.seams.seams import find_vertices
from stitch.tiling.grid import Key, SeamKey, TileGrid, seams_of_tile
from tests.helpers.stitching import OPTIONS, Scene, Tile, clip_scene, mesh_all
from tests.helpers.vtk_writers import write_vtp, write_vtu
from tiler.citymodels.cityjson import write_city_model
from tiler.mesh_files.merged import VERTEX_ID
from tiler.mesh_files.vtk_files import write_pvtp, write_pvtu

Split = tuple[ColumnMesh, Boundary, NDArray[np.int32]]
Pieces = dict[Key, tuple[TetMesh, Boundary]]


@dataclass(frozen=True, eq=False)
class City:
    """A scene meshed in tiles, with all that these were made from."""

    scene: Scene
    grid: TileGrid
    options: AdaptiveOptions
    tiles: dict[Key, Tile]


@dataclass(frozen=True, eq=False)
class SampledDtm:
    """The terrain of a scene as the check wants it."""

    dtm: Dtm

    def sample(self, xy: NDArray[np.float64], /) -> NDArray[np.float64]:
        """Return the height (m) at points (n, 2)."""
        return sample_dtm(self.dtm, xy)


def mesh_city(scene: Scene, grid: TileGrid, options: AdaptiveOptions = OPTIONS) -> City:
    """Mesh all tiles."""
    return City(scene, grid, options, mesh_all(scene, grid, options))


def seam_edges(city: City, key: Key, missing: Collection[SeamKey] = ()) -> SeamEdges:
    """What a tile knows of its neighbours: its own seams, labelled with the houses of its halo."""
    tile, near = city.tiles[key], clip_scene(city.scene, city.grid, key, city.options).model
    south, east, _, _ = seams_of_tile(key)
    inner = [seam for seam in seams_of_tile(key) if seam in tile.columns]
    sides = [Side(tile.seams[seam], seam in (south, east), seam in missing) for seam in inner]
    columns = tile_columns(tile.mesh.plane, [(tile.seams[seam], tile.columns[seam]) for seam in inner])
    return find_seam_edges(tile.mesh.plane, sides, columns, near.numbers)


def split_all(city: City, gone: Collection[Key] = ()) -> dict[Key, Split]:
    """Split the boundaries of all tiles but those that are gone."""
    numbers, bounds = city.scene.model.numbers, city.grid.bounds
    lost = {seam for key in gone for seam in seams_of_tile(key)}
    return {
        key: (tile.mesh, *split_boundary(tile.mesh, numbers, bounds, seam_edges(city, key, lost)))
        for key, tile in city.tiles.items()
        if key not in gone
    }


def cut_city(city: City, gone: Collection[Key] = ()) -> Pieces:
    """Make the pieces that are written: cells and boundary of each tile."""
    pieces: Pieces = {}
    for key, (mesh, boundary, _) in split_all(city, gone).items():
        used, blocks = find_used_points(mesh), CellBlocks([(mesh, None)])
        points, number = UsedPoints(mesh, used), number_used(used)
        places = points.place(points.levels(0, points.n_points))
        cells = TetMesh(places, number[blocks.make(0, blocks.n_cells)])
        pieces[key] = cells, replace(boundary, facets=number[boundary.facets])
    return pieces


def number_city(city: City) -> dict[Key, NDArray[np.int64]]:
    """Give the points of all tiles their ids."""
    ids = {}
    for key, tile in city.tiles.items():
        start = tile.mesh.z_start
        column = number_columns(tile.mesh, *_number_seams(tile), first_id(tile_part(key)))
        ids[key] = np.repeat(column - start[:-1], np.diff(start)) + np.arange(start[-1])
    return ids


def count_city(city: City) -> int:
    """Count the points of all parts, as a run does."""
    counts = []
    for tile in city.tiles.values():
        shared, lowest = _number_seams(tile)
        counts.append(count_by_part(tile.mesh, find_used_points(tile.mesh), shared, lowest))
    return count_all_points(counts)


def _number_seams(tile: Tile) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    shared = [find_vertices(tile.mesh.plane.xy, tile.seams[seam].xy) for seam in tile.columns]
    lowest = [seam_ids(seam, levels) for seam, levels in tile.columns.items()]
    return np.concatenate(shared), np.concatenate(lowest)


def write_numbered(folder: Path, city: City) -> tuple[list[Path], list[Path]]:
    """Write the pieces of a city with the numbers of their points."""
    numbers = number_city(city)
    volumes, boundaries = [], []
    for key, (mesh, boundary) in cut_city(city).items():
        ids = {VERTEX_ID: numbers[key][find_used_points(city.tiles[key].mesh)]}
        volumes.append(folder / f"{key.i}_{key.j}.vtu")
        boundaries.append(folder / f"{key.i}_{key.j}.vtp")
        tile = {"tile": np.full(len(mesh.cells), 10 * key.i + key.j, np.int32)}
        write_vtu(volumes[-1], mesh, point_data=ids, cell_data=tile)
        write_vtp(boundaries[-1], mesh.points, boundary, point_data=ids)
    return volumes, boundaries


def write_tiled_run(folder: Path, city: City, pieces: Mapping[Key, tuple[TetMesh, Boundary]]) -> None:
    """Write a run folder of some pieces, its record with what these have."""
    volumes, boundaries = [], []
    for name in ("mesh", "boundary"):
        (folder / name).mkdir(parents=True)
    for key, (mesh, boundary) in pieces.items():
        name = f"{key.i}_{key.j}"
        volumes.append(folder / "mesh" / f"{name}.vtu")
        boundaries.append(folder / "boundary" / f"{name}.vtp")
        write_vtu(volumes[-1], mesh)
        write_vtp(boundaries[-1], mesh.points, boundary)
    write_pvtu(folder / "mesh.pvtu", volumes)
    write_pvtp(folder / "boundary.pvtp", boundaries)
    model, (west, south, east, north) = city.scene.model, city.grid.bounds
    box = (west, south, 0.0, east, north, 100.0)
    write_city_model(folder / "citymodel.city.json", model, crs="EPSG:28992", bounds=box)
    counts = {
        "cells": sum(len(mesh.cells) for mesh, _ in pieces.values()),
        "points": len(np.unique(np.concatenate([mesh.points for mesh, _ in pieces.values()]), axis=0)),
        "facets": sum(len(boundary.facets) for _, boundary in pieces.values()),
        "buildings": len(model),
    }
    record = {"schema": 1, "status": "done", "region": {"bounds": city.grid.bounds}, "counts": counts}
    (folder / "run.json").write_text(json.dumps(record))
