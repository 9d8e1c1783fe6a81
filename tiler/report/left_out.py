"""What of the buildings of the input is not in the mesh, for the record of a run and who reads it."""

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.data.notes import Note
from tiler.engine.engine import Engine
from tiler.engine.stage import REGION_ITEM
from tiler.stages.left_out import LEFT_OUT
from tiler.words.note_words import reason_of

WORTH_TELLING = 0.005  # share of the building points beside footprints; below it lie eaves and antennas


def describe_left_out(engine: Engine, notes: Sequence[Note]) -> dict[str, Any]:
    """Add up what no building of the mesh stands for.

    Returns
    -------
    dict
        ``footprints`` and ``area (m2)``: footprints of which less than half is under a building, and their bare
        area within the region. ``building points``: points of class 6, or those within footprints that may lie on
        a roof where a file marks none, over no building of the mesh; ``of building points`` of so many;
        ``beside footprints``: those of them in no footprint. ``tallest``: ``id``, ``height (m)``, ``x``, ``y``
        and ``reason`` of the tallest of the footprints, where a height is known.
    """
    sums = {"footprints": 0, "area": 0.0, "points": 0}
    for record in engine.records.of(LEFT_OUT):
        sums = {name: sums[name] + record.facts["left_out"][name] for name in sums}
    points: Mapping[str, int] = engine.records["report", REGION_ITEM].facts["building_points"]
    in_mesh, bare, stray = (points.get(name, 0) for name in ("in_mesh", "bare", "stray"))
    found: dict[str, Any] = {
        "footprints": sums["footprints"],
        "area (m2)": round(sums["area"], 1),
        "building points": bare + stray,
        "of building points": in_mesh + bare + stray,
        "in left-out footprints": sums["points"],
        "beside footprints": stray,
    }
    tallest = engine.records["domain", REGION_ITEM].facts.get("left_out")
    if tallest is not None:
        found["tallest"] = {
            "id": tallest["id"],
            "height (m)": round(tallest["height"], 2),
            "x": round(tallest["x"], 3),
            "y": round(tallest["y"], 3),
            "reason": find_reason(tallest["id"], notes),
        }
    return found


def find_reason(building: str, notes: Sequence[Note]) -> str:
    """Explain why a footprint is not in the mesh, by the notes on it or on its parts.

    Examples
    --------
    >>> find_reason("a", [Note("footprint-on-border-dropped", "a")])
    "it crosses the region's border (--border clip keeps its part)"
    >>> find_reason("b", [])
    'less than half of it is under buildings of the mesh'
    """
    for note in notes:
        if reason_of(note.kind) and any(
            name == building or name.startswith(f"{building}-") for name in note.subject.split(", ")
        ):
            return reason_of(note.kind)
    return "less than half of it is under buildings of the mesh"


def report_left_out(found: Mapping[str, Any]) -> list[str]:
    """Write it in sentences; none where all is in the mesh.

    Examples
    --------
    >>> report_left_out({"footprints": 1, "area (m2)": 412.3, "building points": 1200, "of building points": 4800,
    ...     "in left-out footprints": 1150, "beside footprints": 50,
    ...     "tallest": {"id": "a", "height (m)": 53.83, "x": 1.0, "y": 2.0, "reason": "it crosses the border"}})
    ... # doctest: +NORMALIZE_WHITESPACE
    ['1 footprint (412 m² within the region) is not in the mesh',
     '1,200 of 4,800 building points (25.0 %) are over no building of the mesh: 1,150 in footprints that are left
      out, 50 in no footprint',
     'the tallest building left out: a, 53.8 m, at (1.0, 2.0): it crosses the border']
    """
    n, told = found.get("footprints", 0), []
    if n:
        words = "1 footprint" if n == 1 else f"{n:,} footprints"
        told.append(
            f"{words} ({found['area (m2)']:,.0f} m² within the region) {'is' if n == 1 else 'are'} not in the mesh"
        )
    bare, every = found.get("building points", 0), found.get("of building points", 0)
    if bare and (n or bare >= WORTH_TELLING * every):
        share = f"{bare:,} of {every:,} building points ({100 * bare / every:.1f} %)"
        told.append(
            f"{share} are over no building of the mesh: "
            f"{found['in left-out footprints']:,} in footprints that are left out, "
            f"{found['beside footprints']:,} in no footprint"
        )
    if tallest := found.get("tallest"):
        told.append(
            f"the tallest building left out: {tallest['id']}, {tallest['height (m)']:.1f} m, at "
            f"({tallest['x']:.1f}, {tallest['y']:.1f}): {tallest['reason']}"
        )
    return told
