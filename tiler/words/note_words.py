"""The kinds of notes in words: one sentence each, for the terminal, the report and the page of a run."""

import re
from dataclasses import dataclass

DROPPED, REPAIRED, DEFAULTED, OTHER = "dropped", "repaired or changed", "defaulted", "to know"
GROUPS = (DROPPED, REPAIRED, DEFAULTED, OTHER)
CHOICE = re.compile(r"\[([^]|]*)(?:\|([^]]*))?\]")


@dataclass(frozen=True)
class Words:
    """The words for a kind of note."""

    group: str  #: one of `GROUPS`
    #: with ``{n}`` for the number of notes; ``[s]`` stands for an ending of the plural, ``[was|were]`` for a word
    #: of the singular or of the plural
    sentence: str
    reason: str = ""  #: of what is lost: why one building is not in the mesh; empty where nothing is lost by it


WORDS: dict[str, Words] = {
    "building-beyond-region": Words(
        DROPPED,
        "{n} building[s] [was|were] dropped: the simplified outline leaves the region",
        "its simplified outline leaves the region",
    ),
    "building-covered-by-others": Words(DROPPED, "{n} building[s] [lies|lie] under other buildings"),
    "building-lost": Words(
        DROPPED,
        "{n} building[s] found no room at this clearance (--clearance)",
        "there is no room for it at this clearance (--clearance)",
    ),
    "building-without-height-dropped": Words(
        DROPPED,
        "{n} building[s] without roof points [was|were] dropped (--default-height 0)",
        "it has no roof points, and --default-height is 0",
    ),
    "footprint-duplicate": Words(DROPPED, "{n} footprint[s] [repeats|repeat] the outline of another one"),
    "footprint-empty": Words(
        DROPPED, "{n} footprint[s] without an area [was|were] dropped", "it has no area at the tolerance"
    ),
    "footprint-in-model": Words(
        DROPPED, "{n} footprint[s] [was|were] left out: buildings of the city model or blocks stand there"
    ),
    "footprint-cut-by-model": Words(
        REPAIRED, "{n} footprint[s] [was|were] cut where a building of the city model or a block stands"
    ),
    "footprint-lost": Words(
        DROPPED,
        "{n} footprint[s] [has|have] no area on the grid of the city model",
        "it has no area on the grid of the city model",
    ),
    "footprint-not-finite": Words(
        DROPPED, "{n} footprint[s] with a coordinate that is no number [was|were] dropped"
    ),
    "footprint-not-polygon": Words(
        DROPPED,
        "{n} feature[s] of the footprints [is a point, an open line or a wall|are points, open lines or walls]",
    ),
    "footprint-on-border-dropped": Words(
        DROPPED,
        "{n} footprint[s] on the region's border [was|were] dropped (--border clip keeps the part within it)",
        "it crosses the region's border (--border clip keeps its part)",
    ),
    "footprint-sliver": Words(
        DROPPED, "{n} footprint[s] thinner than a wall [was|were] dropped", "it is thinner than a wall"
    ),
    "footprint-too-many-vertices": Words(
        DROPPED,
        "{n} footprint[s] [has|have] more vertices than a building can have",
        "it has more vertices than a building can have",
    ),
    "footprint-too-small": Words(
        DROPPED,
        "{n} footprint[s] smaller than --min-building-area [was|were] dropped",
        "it is smaller than --min-building-area",
    ),
    "footprint-unreadable": Words(
        DROPPED, "{n} footprint[s] [has a geometry|have geometries] that cannot be read"
    ),
    "footprint-without-height-dropped": Words(
        DROPPED,
        "{n} footprint[s] without roof points [was|were] dropped (--default-height 0)",
        "it has no roof points, and --default-height is 0",
    ),
    "building-outline-changed": Words(
        REPAIRED, "{n} building[s] changed [its outline|their outlines] by more than 30 % of the area"
    ),
    "building-outline-closed": Words(
        REPAIRED, "{n} building[s] [was|were] simplified by [its|their] closed outline[s]"
    ),
    "building-finer-walls": Words(
        OTHER, "walls of {n} building[s] keep less than --clearance, as roofs of the model would be off otherwise"
    ),
    "building-roof-raised": Words(REPAIRED, "{n} roof[s] [was|were] raised over the terrain at the walls"),
    "courtyard-filled": Words(REPAIRED, "{n} courtyard[s] smaller than --min-courtyard-area [was|were] filled"),
    "land-cover-unknown-class": Words(
        DROPPED, "{n} file[s] of land cover [has|have] classes that are not in the table: they are ground"
    ),
    "land-cover-no-polygon": Words(DROPPED, "{n} file[s] of land cover [has|have] features that are no polygons"),
    "trees-left-out": Words(DROPPED, "{n} file[s] of trees [has|have] features that are no trees"),
    "no-trees-in-region": Words(OTHER, "no tree of the file lies in the region"),
    "water-levels-differ": Words(
        OTHER, "{n} bod[y|ies] of water [has|have] several declared levels: the lowest counts"
    ),
    "damaged-artefact": Words(
        REPAIRED, "{n} damaged or missing result[s] of an earlier run [was|were] computed again"
    ),
    "footprint-id-repeated": Words(REPAIRED, "{n} id[s] of several footprints [was|were] completed by geometry"),
    "footprint-on-border-clipped": Words(
        REPAIRED,
        "{n} footprint[s] on the region's border [was|were] clipped",
        "its part within the region is no wider than the clearance at the border",
    ),
    "footprint-repaired": Words(REPAIRED, "{n} footprint[s] with an invalid ring [was|were] repaired"),
    "footprint-spike": Words(REPAIRED, "{n} footprint[s] lost a spike or slit"),
    "footprint-split": Words(REPAIRED, "{n} footprint[s] [was|were] split into parts"),
    "model-fault": Words(DROPPED, "{n} geometr[y|ies] of the city model cannot be read"),
    "model-in-two-files": Words(
        DROPPED, "{n} building[s] [is|are] in another city model, too, and count[s|] there"
    ),
    "model-without-place": Words(
        DROPPED, "{n} building[s] of the city model [has|have] neither faces nor an outline", "it has no geometry"
    ),
    "model-roof-overhang": Words(REPAIRED, "{n} roof[s] of the city model [was|were] cut off at the walls"),
    "model-self-crossing": Words(
        REPAIRED, "{n} building[s] of the city model [has|have] surfaces that cross themselves"
    ),
    "model-steep-roof": Words(
        REPAIRED, "{n} building[s] of the city model [has|have] roofs so steep that they are taken for walls"
    ),
    "model-not-planar": Words(
        REPAIRED, "{n} building[s] of the city model [has|have] roof surfaces that are not planar"
    ),
    "plane-refinement-stopped": Words(
        REPAIRED, "{n} plane mesh[|es] reached the limit on added vertices; angles may be small"
    ),
    "soil-lowered-under-roof": Words(
        REPAIRED, "{n} place[s] of the terrain inside a house reached its roof and [was|were] lowered"
    ),
    "solid-flat": Words(
        REPAIRED, "{n} building[s] [has|have] no solid in the CityJSON: the roof is not above the ground"
    ),
    "solid-into-ground": Words(
        REPAIRED, "{n} sloped roof[s] [meets|meet] the ground; [its solid is|their solids are] cut off there"
    ),
    "solid-touching": Words(
        REPAIRED,
        "{n} outline[s] that [touches itself|touch themselves] [was|were] split for [its solid|their solids]",
    ),
    "model-axes": Words(DEFAULTED, "the order of axes of city models was detected from their coordinates"),
    "model-ground": Words(DEFAULTED, "the ground is that of the city model, as none is given"),
    "model-lower-level": Words(
        DEFAULTED, "{n} building[s] of the city model [has|have] no roof at the best level: a lower one was taken"
    ),
    "model-no-roof": Words(
        DEFAULTED, "{n} building[s] of the city model [has|have] no roof: a height over the outline was taken"
    ),
    "model-off-ground": Words(
        OTHER, "{n} building[s] of the city model [stands|stand] more than 5 m above or below the ground"
    ),
    "model-off-neighbours": Words(
        OTHER, "{n} building[s] of the city model [stands|stand] more than 15 m above or below those around"
    ),
    "model-shifted": Words(DEFAULTED, "city models were moved onto the terrain: --shift-z auto"),
    "model-shift": Words(OTHER, "the city model lies above or below the ground as a whole: see --shift-z"),
    "model-roof-gap": Words(
        DEFAULTED, "{n} roof[s] of the city model [has|have] a gap that took the nearest surface"
    ),
    "model-roof-unused": Words(
        DEFAULTED, "{n} roof[s] of the city model [does|do] not cover the house, and [was|were] not used"
    ),
    "building-ground-from-dtm": Words(
        DEFAULTED, "{n} building part[s] without ground points took the ground height of the terrain"
    ),
    "building-roof-from-attribute": Words(
        DEFAULTED, "{n} building part[s] without roof points took the height of the footprint's attribute"
    ),
    "building-roof-from-default": Words(
        DEFAULTED, "{n} building part[s] without roof points took --default-height"
    ),
    "footprint-ground-from-dtm": Words(
        DEFAULTED, "{n} footprint[s] without ground points took the ground height of the terrain"
    ),
    "footprint-height-missing": Words(
        DEFAULTED, "{n} footprint[s] [has|have] a height attribute that is no height"
    ),
    "footprint-roof-unread": Words(
        DEFAULTED, "{n} footprint[s] [has|have] attributes of the roof that are out of bounds or cannot be read"
    ),
    "footprint-roof-form-unused": Words(
        DEFAULTED, "{n} footprint[s] cannot have the shape of roof that [its attribute|their attributes] name[s|]"
    ),
    "footprint-roof-form-replaced": Words(
        DEFAULTED, "{n} footprint[s] got a hipped roof instead of the pyramidal one that [it names|they name]"
    ),
    "footprint-roof-form-lowered": Words(
        REPAIRED, "{n} roof[s] of a given form [was|were] made lower, so that the eaves are above the ground"
    ),
    "footprint-roof-form-off": Words(
        OTHER, "{n} roof[s] of a given form [lies|lie] more than 1 m from [its|their] points"
    ),
    "footprint-roof-forms": Words(OTHER, "attributes of footprints name shapes of roofs"),
    "footprint-roof-forms-unknown": Words(
        DEFAULTED, "attributes of footprints name shapes of roofs that are not supported"
    ),
    "footprint-roofs-by-levels": Words(DEFAULTED, "heights of roofs were taken from numbers of levels, 3 m each"),
    "footprint-id-missing": Words(DEFAULTED, "{n} footprint[s] without an id got one from the geometry"),
    "footprint-roof-from-attribute": Words(
        DEFAULTED, "{n} footprint[s] without roof points took the height of the attribute"
    ),
    "footprint-roof-from-default": Words(DEFAULTED, "{n} footprint[s] without roof points took --default-height"),
    "footprints-without-crs": Words(DEFAULTED, "the footprint file states no CRS: it was taken as the region's"),
    "ground-filter": Words(DEFAULTED, "ground points were classified by the built-in filter"),
    "no-building-class": Words(
        DEFAULTED, "point clouds without a building class: roof points were found within footprints"
    ),
    "building-points-without-footprints": Words(
        OTHER, "the point cloud has building points, but the region no footprints"
    ),
    "crs-without-epsg": Words(OTHER, "the CRS has no EPSG code"),
    "crs-accuracy": Words(OTHER, "{n} reprojection[s] [is|are] less exact than the clearance"),
    "cloud-without-crs": Words(DEFAULTED, "point clouds without a CRS got one"),
    "cloud-crs-overruled": Words(DEFAULTED, "--crs replaced the CRS that point clouds state"),
    "cloud-crs-alike": Words(OTHER, "point clouds name one CRS in several ways"),
    "cloud-unit-of-key": Words(DEFAULTED, "the unit of point clouds is not that of their CRS"),
    "cloud-height-unit": Words(DEFAULTED, "the unit of heights was chosen"),
    "cloud-height-converted": Words(REPAIRED, "heights of point clouds were converted to metres"),
    "cloud-converted": Words(REPAIRED, "coordinates of point clouds were converted to metres, east and north"),
    "cloud-axes": Words(DEFAULTED, "axes of point clouds are not those of their CRS"),
    "cloud-reprojected": Words(REPAIRED, "point clouds were reprojected"),
    "cloud-off-its-crs": Words(OTHER, "point clouds lie outside the area of use of the CRS"),
    "cloud-void-header-box": Words(
        REPAIRED, "{n} point cloud[s] without valid bounds in the header [was|were] read to find them"
    ),
    "footprints-axes": Words(DEFAULTED, "axes of the footprints are not those of their CRS"),
    "footprints-converted": Words(REPAIRED, "coordinates of the footprints were converted to metres"),
    "footprints-operation": Words(OTHER, "the footprints were reprojected by one operation"),
    "footprints-misaligned": Words(OTHER, "the footprints lie beside the roofs in the point cloud"),
    "alignment-unknown": Words(OTHER, "the shift between footprints and roofs could not be measured"),
    "footprint-roof-from-other-classes": Words(
        DEFAULTED, "{n} footprint[s] without points of the building class took smooth points of other classes"
    ),
    "footprint-curve-linearised": Words(
        REPAIRED, "arcs of {n} footprint[s] were replaced by segments within 0.01 m"
    ),
    "footprint-from-line": Words(
        REPAIRED, "{n} footprint[s] [is the outline of a closed line|are outlines of closed lines]"
    ),
    "footprint-outline-of-surface": Words(
        REPAIRED, "{n} footprint[s] [is|are] the plan outline of faces in space"
    ),
    "footprint-heights-by-levels": Words(DEFAULTED, "heights were taken from numbers of levels, 3 m each"),
    "footprints-without-metadata": Words(DEFAULTED, "the Parquet file has no metadata of geometries"),
    "footprints-layer-chosen": Words(OTHER, "the polygon layer of OpenStreetMap data was used"),
    "footprint-outlines-of-parts": Words(
        OTHER, "outlines of buildings were reduced to the area that their parts do not cover"
    ),
    "footprint-outlines-replaced": Words(OTHER, "outlines of buildings were left out: their parts cover them"),
    "footprint-parts": Words(OTHER, "parts of buildings (building:part) became one footprint each"),
    "footprint-parts-covered": Words(OTHER, "parts of buildings below higher parts were left out"),
    "footprint-parts-raised": Words(
        OTHER, "parts of buildings that begin above the ground were extended down to it"
    ),
    "footprints-not-buildings": Words(OTHER, "polygons of OpenStreetMap that are no buildings were left out"),
    "footprints-of-osm": Words(OTHER, "tags of OpenStreetMap select the buildings and give their heights"),
    "footprints-without-geometry": Words(OTHER, "the footprints have features without a geometry"),
    "footprint-roof-like-plants": Words(
        OTHER, "{n} footprint[s] without roof points [has|have] unused vegetation points as smooth as a roof"
    ),
    "upload-instead-of-points": Words(
        OTHER, "{n} uploaded building[s] [tells its|tell their] own height[s], roof points there do not count"
    ),
    "domain-lower-than-guidelines": Words(OTHER, "the domain is lower than six times the tallest building"),
    "footprints-outside": Words(OTHER, "footprints lie beyond the region"),
    "footprints-reader-warning": Words(OTHER, "the reader of the footprints gave {n} warning[s]"),
    "footprints-reprojected": Words(OTHER, "the footprints were reprojected to the region's CRS"),
    "mesh-in-parts": Words(OTHER, "the mesh has parts that share no face"),
    "terrain-far-from-points": Words(OTHER, "terrain was interpolated over large areas without ground points"),
    "no-footprints-in-region": Words(OTHER, "no footprint of a file lies in the region"),
    "no-cells-in-zones": Words(OTHER, "no cell of the generalised blocks lies in a zone that takes blocks"),
}


def say_notes(kind: str, n: int) -> str:
    """Return how many notes of a kind there are, in a sentence without a full stop.

    A kind that is not known, as of stages of the user's own, is named as it is.

    Examples
    --------
    >>> say_notes("footprint-on-border-clipped", 1), say_notes("footprint-on-border-clipped", 5200)
    ("1 footprint on the region's border was clipped", "5,200 footprints on the region's border were clipped")
    >>> say_notes("plane-refinement-stopped", 2)
    '2 plane meshes reached the limit on added vertices; angles may be small'
    >>> say_notes("odd", 3)
    '3 notes: odd'
    """
    known = WORDS.get(kind)
    sentence = known.sentence if known is not None else f"{{n}} note[s]: {kind.replace('-', ' ')}"

    def choose(found: re.Match[str]) -> str:
        one, many = found[1], found[2]
        if many is None:
            one, many = "", one
        return one if n == 1 else many

    return CHOICE.sub(choose, sentence).replace("{n}", f"{n:,}")


def group_of(kind: str) -> str:
    """Give the group of a kind of notes, `OTHER` of one that is not known.

    Examples
    --------
    >>> group_of("footprint-lost"), group_of("my-own-rule")
    ('dropped', 'to know')
    """
    known = WORDS.get(kind)
    return OTHER if known is None else known.group


def is_drop(kind: str) -> bool:
    """Return whether a kind of note says that something of the input was dropped.

    Examples
    --------
    >>> is_drop("footprint-on-border-dropped"), is_drop("building-lost"), is_drop("courtyard-filled")
    (True, True, False)
    """
    return group_of(kind) == DROPPED or kind.endswith("-dropped")


def reason_of(kind: str) -> str:
    """Why a building with such a note is not in the mesh; empty where the note is no reason for that.

    Examples
    --------
    >>> reason_of("building-lost")
    'there is no room for it at this clearance (--clearance)'
    """
    known = WORDS.get(kind)
    return "" if known is None else known.reason
