"""Building footprints from vector files: CRS, box, polygons, ids and given heights (step 1.2)."""

from pathlib import Path

import pyproj

from pipeline.citymodel import Footprints
from pipeline.notes import Note
from tiler.footprints.footprint_index import join_footprints, scan_footprints
from tiler.georeference.crs import horizontal_crs
from tiler.georeference.frame import Frame
from tiler.objects.places import as_place
from tiler.vectors.features import Box
from tiler.vectors.layers import describe_layer


def read_footprint_crs(path: str | Path, layer: str = "") -> pyproj.CRS | None:
    """Read the CRS that a footprint file states.

    Parameters
    ----------
    path : str or Path
        SHP, GPKG, GeoJSON, FlatGeobuf, OSM or GeoParquet.
    layer : str
        Name of the layer, ``""`` for the only one.

    Returns
    -------
    pyproj.CRS or None
        None if it states none, or one without a place on Earth.

    Raises
    ------
    InputError
        If the file cannot be read.
    ConfigError
        If the layer does not exist, or there are several and none is named.
    """
    crs = describe_layer(as_place(path), layer).crs
    return None if horizontal_crs(crs) is None else crs


def read_footprints(
    path: str | Path,
    *,
    crs: pyproj.CRS,
    bounds: Box,
    layer: str = "",
    id_attribute: str = "",
    height_attribute: str = "",
    frame: Frame | None = None,
) -> tuple[Footprints, tuple[Note, ...]]:
    """Read the footprints that meet a box (step 1.2).

    Parameters
    ----------
    path : str or Path
        SHP, GPKG, GeoJSON, FlatGeobuf, OSM or GeoParquet.
    crs : pyproj.CRS
        The region's CRS, to which footprints in another are reprojected.
    bounds : tuple of 4 floats
        xmin, ymin, xmax, ymax in the region's CRS (m); the borders belong to the box.
    layer : str
        Name of the layer, ``""`` for the only one.
    id_attribute : str
        Attribute with the building's id; ``""`` for the first of `ID_ATTRIBUTES` that the layer has.
    height_attribute : str
        Attribute with the height above ground (m); ``""`` for none.
    frame : Frame, optional
        How coordinates of the file become those of the region; by default as the CRSs have it.

    Returns
    -------
    Footprints
        By ascending id. Polygons and multipolygons, valid or not, without Z: see `outline_all`.
    tuple of Note
        What was converted, left out, assumed or renamed; a note each for what `outline_all` tells,
        ``footprint-not-finite``, ``footprint-id-missing``,
        ``footprint-id-repeated`` and ``footprint-height-missing``; and one a file for
        ``footprints-without-crs``, ``footprints-reprojected``, ``footprints-outside`` and
        ``footprints-reader-warning``.

    Raises
    ------
    InputError
        If the file cannot be read, or its coordinates do not fit its CRS.
    ConfigError
        If the layer or an attribute does not exist.

    Notes
    -----
    The id attribute is chosen by its name alone, so that a building's id does not depend on which others
    are read with it. A building without an id gets one from its geometry. An id that several different
    geometries carry, anywhere in the file, is completed by their geometry: see `find_repeated_ids`.
    """
    blocks = list(
        scan_footprints(
            path,
            crs=crs,
            bounds=bounds,
            layer=layer,
            id_attribute=id_attribute,
            height_attribute=height_attribute,
            frame=frame,
        )
    )
    notes = tuple(note for block in blocks for note in block.notes)
    return join_footprints([block.rows for block in blocks], bounds), notes
