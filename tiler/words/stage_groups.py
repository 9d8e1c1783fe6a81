"""Stages in words of the field: the groups that a user sees, and what each stage of a group does."""

from collections.abc import Iterable

POINTS, TERRAIN, BUILDINGS, SIMPLIFICATION = "points", "terrain", "buildings", "simplification"
SEAMS, MESH, OUTPUT = "seams", "mesh", "output"
GROUPS = (POINTS, TERRAIN, BUILDINGS, SIMPLIFICATION, SEAMS, MESH, OUTPUT)

# Group and task of each stage; of rounds that are numbered, without the number. The last stage of each group is
# known when a run begins, so that a group is not done before it.
STAGES: dict[str, tuple[str, str]] = {
    "points": (POINTS, "point-cloud files"),
    "ground": (TERRAIN, "means of ground points"),
    "flooded": (TERRAIN, "small gaps"),
    "coarse": (TERRAIN, "coarse grid for large gaps"),
    "lakes": (TERRAIN, "large gaps"),
    "terrain": (TERRAIN, "grid"),
    "model-outlines": (BUILDINGS, "city models"),
    "footprints": (BUILDINGS, "footprint file"),
    "block-cells": (BUILDINGS, "cells of blocks"),
    "blocks": (BUILDINGS, "blocks"),
    "edits": (BUILDINGS, "edits of tiles"),
    "outlines": (BUILDINGS, "footprints of tiles"),
    "reserved": (BUILDINGS, "ids"),
    "alignment": (BUILDINGS, "footprints over roofs"),
    "shift": (BUILDINGS, "shift of the footprints"),
    "houses": (BUILDINGS, "outlines and heights"),
    "near-": (SIMPLIFICATION, "close buildings"),
    "join-": (SIMPLIFICATION, "clusters"),
    "members-": (SIMPLIFICATION, "clusters of tiles"),
    "shapes-": (SIMPLIFICATION, "outlines"),
    "model": (SIMPLIFICATION, "city model"),
    "left-out": (SIMPLIFICATION, "footprints left out"),
    "summits": (SEAMS, "highest ground"),
    "domain": (SEAMS, "height of the domain"),
    "rim": (SEAMS, "ground at the border of the region"),
    "approach": (SEAMS, "ground of the pad"),
    "wet": (TERRAIN, "water by points"),
    "cover": (TERRAIN, "files of land cover"),
    "covered": (SEAMS, "land cover of tiles"),
    "water": (SEAMS, "heights of water"),
    "levels": (SEAMS, "levels of bodies of water"),
    "levelled": (SEAMS, "ground with level water"),
    "trees": (TERRAIN, "file of trees"),
    "leaves": (SEAMS, "leaves in columns"),
    "layers": (SEAMS, "layers of roofs"),
    "seams": (SEAMS, "seams"),
    "columns": (MESH, "columns of cells"),
    "pieces": (OUTPUT, "files of the mesh"),
    "citymodel": (OUTPUT, "file of the city model"),
    "citymodel-full": (OUTPUT, "file of the full city model"),
    "fit": (OUTPUT, "distance of points to the model"),
    "report": (OUTPUT, "quality"),
}


def group_of_stage(stage: str) -> str:
    """Give the group of a stage; one of the user's own is its own group.

    Examples
    --------
    >>> group_of_stage("near-0"), group_of_stage("flooded"), group_of_stage("canopy-2")
    ('simplification', 'terrain', 'canopy-2')
    """
    found = STAGES.get(stage) or STAGES.get(stage.rstrip("0123456789"))
    return stage if found is None else found[0]


def title_of_stage(stage: str) -> str:
    """Describe what a stage does, in the words of its group; one of the user's own by its name.

    Examples
    --------
    >>> title_of_stage("near-1"), title_of_stage("columns"), title_of_stage("canopy")
    ('simplification: close buildings, round 2', 'mesh: columns of cells', 'canopy')
    """
    name = stage.rstrip("0123456789")
    found = STAGES.get(stage) or STAGES.get(name)
    if found is None:
        return stage
    number = stage[len(name) :]
    return f"{found[0]}: {found[1]}" + (f", round {int(number) + 1}" if name.endswith("-") and int(number) else "")


def place_of_item(stage: str, scope: str, name: str) -> str:
    """Name in an error where it arose: what the stage does, or the name of one of the user's own, and the item.

    Examples
    --------
    >>> place_of_item("points", "file", "a"), place_of_item("coarse", "region", "region")
    ('points: point-cloud files, file a', 'terrain: coarse grid for large gaps')
    >>> place_of_item("canopy", "tile", "1_2")
    'stage canopy, tile 1_2'
    """
    title = title_of_stage(stage)
    if title == stage:
        return f"stage {stage}, {scope} {name}"
    return title if name == scope else f"{title}, {scope} {name}"


def group_stages(stages: Iterable[str]) -> dict[str, list[str]]:
    """Put stages into their groups: ours in the order of `GROUPS`, then the user's own.

    Examples
    --------
    >>> group_stages(["footprints", "points", "canopy", "houses"])
    {'points': ['points'], 'buildings': ['footprints', 'houses'], 'canopy': ['canopy']}
    """
    found: dict[str, list[str]] = {group: [] for group in GROUPS}
    for stage in stages:
        found.setdefault(group_of_stage(stage), []).append(stage)
    return {group: names for group, names in found.items() if names}
