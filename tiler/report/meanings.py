"""What the kinds of notes mean, for readers of the report."""

DROPPED, REPAIRED, DEFAULTED, OTHER = "dropped", "repaired or changed", "defaulted", "to know"
GROUPS = (DROPPED, REPAIRED, DEFAULTED, OTHER)

MEANINGS: dict[str, tuple[str, str]] = {
    "building-beyond-region": (DROPPED, "simplified outline leaves the region"),
    "building-covered-by-others": (DROPPED, "lies under other buildings"),
    "building-lost": (DROPPED, "no room for it at this clearance"),
    "footprint-empty": (DROPPED, "no geometry, or no area at the tolerance"),
    "footprint-lost": (DROPPED, "no area on the grid of the city model"),
    "footprint-not-finite": (DROPPED, "a coordinate is not finite"),
    "footprint-not-polygon": (DROPPED, "is a point, an open line or a wall, and has no outline"),
    "footprint-on-border-dropped": (DROPPED, "crosses the region's border (--border clip keeps its part)"),
    "footprint-sliver": (DROPPED, "thinner than the tolerance"),
    "footprint-too-many-vertices": (DROPPED, "more vertices than a building can have"),
    "footprint-too-small": (DROPPED, "smaller than --min-building-area"),
    "footprint-unreadable": (DROPPED, "the geometry cannot be parsed"),
    "footprint-duplicate": (DROPPED, "the same outline again"),
    "building-without-height-dropped": (DROPPED, "no roof points, and --default-height is 0"),
    "footprint-without-height-dropped": (DROPPED, "no roof points, and --default-height is 0"),
    "building-outline-changed": (REPAIRED, "outline changed by more than 30 % of its area"),
    "building-outline-closed": (REPAIRED, "simplified by its closed outline"),
    "building-roof-raised": (REPAIRED, "roof raised over the terrain at its walls"),
    "courtyard-filled": (REPAIRED, "courtyard smaller than --min-courtyard-area"),
    "damaged-artefact": (REPAIRED, "damaged or missing result of an earlier run, made anew"),
    "footprint-curve-linearised": (REPAIRED, "arcs made segments within 0.01 m"),
    "footprint-from-line": (REPAIRED, "outline of closed lines"),
    "footprint-outline-of-surface": (REPAIRED, "plan outline of faces in space"),
    "footprint-id-repeated": (REPAIRED, "id of several footprints, completed by geometry"),
    "footprint-on-border-clipped": (REPAIRED, "clipped to the region"),
    "footprint-repaired": (REPAIRED, "ring was invalid and was mended"),
    "footprint-spike": (REPAIRED, "spike or slit removed"),
    "footprint-split": (REPAIRED, "fell into parts"),
    "plane-refinement-stopped": (REPAIRED, "limit on added vertices reached; angles may be small"),
    "soil-lowered-under-roof": (REPAIRED, "terrain inside a house reached its roof and was lowered"),
    "solid-flat": (REPAIRED, "roof not above the ground: no solid in the CityJSON"),
    "solid-touching": (REPAIRED, "solid touches itself"),
    "building-ground-from-dtm": (DEFAULTED, "no ground points: ground height of the terrain"),
    "building-roof-from-attribute": (DEFAULTED, "no roof points: height of the footprint's attribute"),
    "building-roof-from-default": (DEFAULTED, "no roof points: --default-height"),
    "footprint-ground-from-dtm": (DEFAULTED, "no ground points: ground height of the terrain"),
    "footprint-height-missing": (DEFAULTED, "attribute of the height is no height"),
    "footprint-heights-by-levels": (DEFAULTED, "no height: number of levels x 3 m"),
    "footprint-id-missing": (DEFAULTED, "no id: named by its geometry"),
    "footprint-roof-from-attribute": (DEFAULTED, "no roof points: height of the footprint's attribute"),
    "footprint-roof-from-default": (DEFAULTED, "no roof points: --default-height"),
    "footprints-without-metadata": (DEFAULTED, "Parquet without metadata of geometries: what was taken"),
    "footprints-without-crs": (DEFAULTED, "file without a CRS: taken as the region's"),
    "ground-filter": (DEFAULTED, "ground found by our own filter"),
    "building-points-without-footprints": (OTHER, "points of buildings, but no footprints in the region"),
    "crs-without-epsg": (OTHER, "the CRS has no EPSG code"),
    "domain-lower-than-guidelines": (OTHER, "the domain is lower than six times the tallest building"),
    "footprints-layer-chosen": (OTHER, "layer of polygons taken of data of OpenStreetMap"),
    "footprints-not-buildings": (OTHER, "polygons of OpenStreetMap that are no buildings, left out"),
    "footprints-of-osm": (OTHER, "which tags of OpenStreetMap were taken"),
    "footprints-outside": (OTHER, "footprints beyond the region"),
    "footprints-reader-warning": (OTHER, "what the reader of the footprints said"),
    "footprints-reprojected": (OTHER, "footprints were reprojected to the region's CRS"),
    "footprints-without-geometry": (OTHER, "features that have no geometry"),
    "no-footprints-in-region": (OTHER, "terrain only"),
    "no-building-class": (DEFAULTED, "files without a building class: roof points found otherwise"),
}


def explain(kind: str) -> tuple[str, str]:
    """Give group and meaning of a kind of notes; one that is not known is told as it is.

    Examples
    --------
    >>> explain("footprint-lost")
    ('dropped', 'no area on the grid of the city model')
    >>> explain("my-own-rule")
    ('to know', '')
    """
    return MEANINGS.get(kind, (OTHER, ""))
