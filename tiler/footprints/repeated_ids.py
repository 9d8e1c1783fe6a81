"""Ids that several different footprints of a file carry, found without keeping the file (step 1.2)."""

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.data.citymodel import make_ids
from tiler.footprints.footprint_attributes import id_columns, read_ids
from tiler.footprints.plan_outlines import outline_all
from tiler.vectors.layers import BATCH, Layer, scan_layer


def find_repeated_ids(layer: Layer, id_name: str, *, batch: int = BATCH) -> set[str]:
    """Find the ids that at least two different polygons of a layer carry; none where `id_name` is ``""``.

    Polygons that are equal whatever their start vertex are one. InputError if the file is damaged.

    Notes
    -----
    A fact of the whole file, whatever part of it a region needs. The attribute alone is read first, and
    8 bytes a feature are kept. Only where some of these are equal are the geometries read, in a second pass,
    and those of equal ids compared.
    """
    if not id_name:
        return set()
    columns = id_columns(layer, id_name)
    hashes = np.concatenate(
        [np.empty(0, np.int64)]
        + [
            _hashes(read_ids(layer, id_name, features))
            for features in scan_layer(layer, columns, None, geometry=False, batch=batch)
        ]
    )
    hashes.sort()
    twice = np.unique(hashes[1:][hashes[1:] == hashes[:-1]])
    twice = twice[twice != hash("")]
    return _different(layer, id_name, twice, batch) if len(twice) else set()


def _hashes(names: list[str]) -> NDArray[np.int64]:
    """Hash the ids; the hashes differ from run to run, so only their being equal may be used."""
    return np.fromiter(map(hash, names), np.int64, len(names))


def _different(layer: Layer, id_name: str, twice: NDArray[np.int64], batch: int) -> set[str]:
    shapes: dict[str, str] = {}
    repeated = set()
    for features in scan_layer(layer, id_columns(layer, id_name), None, batch=batch):
        names = read_ids(layer, id_name, features)
        hits = np.flatnonzero(np.isin(_hashes(names), twice))
        outlines = outline_all(features.wkb[hits], metre=layer.metre)
        finite = np.isfinite(shapely.bounds(outlines.geometry)).all(axis=1)
        rows = hits[outlines.rows[finite]].tolist()
        for row, shape in zip(rows, make_ids(outlines.geometry[finite]), strict=True):
            if shapes.setdefault(names[row], str(shape)) != shape:
                repeated.add(names[row])
    return repeated
