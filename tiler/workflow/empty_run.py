"""A run that was given footprints and meshed no building: what was seen, why, and what to do."""

from collections.abc import Sequence

import numpy as np
import pyproj

from pipeline.data.errors import CityError, InputError
from pipeline.data.notes import Note, count_notes
from tiler.config.config import Config
from tiler.georeference.crs import boxes_meet, is_on_its_place, short_crs
from tiler.objects.places import place
from tiler.planning.region import Region
from tiler.vectors.features import Box
from tiler.vectors.layers import Layer, describe_layer
from tiler.words.note_words import is_drop, say_notes
from tiler.words.plain_text import format_box

DEGREES = "EPSG:4326"
# What was assumed of the coordinates, and may be wrong.
ASSUMED = ("cloud-crs-overruled", "cloud-without-crs", "cloud-axes", "cloud-off-its-crs")
UNKNOWN = "check --crs, the CRS that the file states, and --bounds"


class EmptyMeshError(InputError):
    """The mesh has no building although footprints were given."""


def is_empty(config: Config, counts: dict[str, int]) -> bool:
    """Whether footprints were given, and no building was meshed."""
    return config.has_buildings and not counts.get("buildings", 0)


def explain_empty(config: Config, region: Region, counts: dict[str, int], notes: Sequence[Note]) -> str:
    """Explain why there is no building, and the next move.

    Parameters
    ----------
    config : Config
        Parameters of the run.
    region : Region
        What was meshed.
    counts : dict
        ``"footprints read"``: those in the region.
    notes : sequence of Note
        All notes of the run.
    """
    within = counts.get("footprints read", 0)
    try:
        layer = describe_layer(place(config.footprints), config.layer)
    except CityError:  # it was read before; what it says now does not matter
        layer = None
    seen = _format_number(layer, within, format_box(region.bounds), short_crs(region.crs))
    dropped = "; ".join(say_notes(kind, n) for kind, n in count_notes(notes).items() if is_drop(kind))
    told = [seen, dropped]
    if within:
        told.append("run.json names each one; see --min-building-area, --default-height and --border")
    elif layer is not None:
        told.append(find_place(layer, region))
    told += [note.detail for note in notes if note.kind in ASSUMED]
    told.append(f"--allow-empty accepts a mesh without buildings; this one stays in {config.out} for a look")
    return f"no building was meshed. {config.footprints} has {'. '.join(part for part in told if part)}"


def _format_number(layer: Layer | None, within: int, box: str, crs: str) -> str:
    number = "footprints"
    if layer is not None and layer.n_features >= 0:
        number = "1 feature" if layer.n_features == 1 else f"{layer.n_features:,} features"
    found = f"{within:,}" if within else "none"
    return f"{number}, {found} of them in the region, {box} ({crs})"


def find_place(layer: Layer, region: Region) -> str:
    """Describe where the footprints of a layer lie, and whether they would lie in the region if read otherwise.

    Looked at are x and y exchanged, in metres or degrees, and degrees in a file that does not say so.

    Examples
    --------
    >>> from pathlib import Path
    >>> swapped = Layer(Path("a.shp"), "a", None, (), 3, (487_200.0, 120_000.0, 487_300.0, 120_200.0))
    >>> find_place(swapped, Region((120_000.0, 487_000.0, 121_000.0, 488_000.0), "EPSG:28992", 500.0))
    ... # doctest: +NORMALIZE_WHITESPACE
    'They lie in 487200 to 487300, 120000 to 120200 (no CRS stated). With x and y exchanged they lie in the region:
     exchange them in the file (QGIS: Swap X and Y coordinates)'
    """
    if layer.extent is None or not np.isfinite(layer.extent).all():
        return f"The file does not say where they lie: {UNKNOWN}"
    crs = "no CRS stated" if layer.crs is None else short_crs(layer.crs.to_string())
    told = f"They lie in {format_box(layer.extent)} ({crs})"
    own = layer.crs or pyproj.CRS.from_user_input(region.crs)
    if _meets(layer.extent, own, region):
        return f"{told}: none that can be read meets the region"
    for exchanged in (False, True):
        extent = _exchange(layer.extent) if exchanged else layer.extent
        for degrees in (False, True):
            stated = DEGREES if degrees else own
            if (degrees and not _are_degrees(extent)) or not (degrees or exchanged):
                continue
            if _meets(extent, pyproj.CRS.from_user_input(stated), region):
                return f"{told}. {_describe_move(exchanged=exchanged, degrees=degrees and not own.is_geographic)}"
    code = own.to_authority()
    if (
        code
        and own.is_projected
        and boxes_meet(layer.extent, region.bounds)
        and is_on_its_place(layer.extent, own)
    ):
        return (
            f"{told}. The point clouds have such coordinates too, so their CRS may be that of the footprints: "
            f"--crs {':'.join(code)}"
        )
    return f"{told}: {UNKNOWN}"


def _describe_move(*, exchanged: bool, degrees: bool) -> str:
    if degrees and exchanged:
        return (
            "Taken as degrees, latitude first, they lie in the region: exchange x and y in the file "
            f"(QGIS: Swap X and Y coordinates) and state {DEGREES} as its CRS"
        )
    if degrees:
        return f"Taken as degrees they lie in the region: state that as their CRS, ogr2ogr -a_srs {DEGREES}"
    return (
        "With x and y exchanged they lie in the region: exchange them in the file (QGIS: Swap X and Y coordinates)"
    )


def _exchange(box: Box) -> Box:
    return box[1], box[0], box[3], box[2]


def _are_degrees(box: Box) -> bool:
    return max(abs(box[0]), abs(box[2])) <= 180 and max(abs(box[1]), abs(box[3])) <= 90


def _meets(extent: Box, crs: pyproj.CRS, region: Region) -> bool:
    """Whether a box in some CRS meets the region."""
    if crs.is_geographic and not _are_degrees(extent):
        return False
    forward = pyproj.Transformer.from_crs(crs, region.crs, always_xy=True)
    west, south, east, north = forward.transform_bounds(*extent, densify_pts=21, errcheck=False)
    if not np.isfinite((west, south, east, north)).all():
        return False
    return boxes_meet((west, south, east, north), region.bounds)
