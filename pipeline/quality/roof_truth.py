"""Roofs of a city model held against the true ones of a synthetic town: types, planes, angles and heights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

SAME_ANGLE, SAME_HEIGHT = 3.0, 0.15  # degrees and m: faces that agree so well are of one plane
SLOPED = 5.0  # degrees, from which on a plane is sloped
MAIN = 0.08  # of the area of the main body: planes with less say nothing of its type
POINT = 0.25  # m from one point, in which the planes of a pyramid meet
STEP = 0.5  # m between the places where heights are compared
TYPES = ("flat", "shed", "gabled", "hipped", "pyramidal", "all")

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FoundRoof:
    """The roof of a house in a city model."""

    faces: NDArray[np.object_]  #: (f,): its faces in plan, shapely Polygons (m)
    planes: Array  #: (f, 3): ``z = a x + b y + c`` of each (m)
    outline: shapely.Geometry  #: what the house covers (m)


@dataclass(frozen=True, eq=False)
class Comparison:
    """How a roof differs from its truth."""

    kind: str  #: true type of the main roof, one of `TYPES`
    #: whether the main roof is of this type, and whether all roofs of the house have as many planes as in truth
    same_type: bool
    same_planes: bool
    angles: Array  #: (p,): angle between each true plane of the main roof and the one found there (degrees)
    outline: float  #: area by which outlines differ over the length of the true one (m)
    errors: Array  #: (n,): found less true heights of the main roof, at places of a grid (m)


def make_roof(faces: Sequence[Sequence[Array]], ground: Sequence[shapely.Polygon]) -> FoundRoof:
    """Make a roof of the rings (k, 3) of its faces, shells first, and of the grounds of its parts."""
    polygons = [shapely.Polygon(rings[0][:, :2], [ring[:, :2] for ring in rings[1:]]) for rings in faces]
    middle = np.mean([rings[0][0, :2] for rings in faces], axis=0)
    planes = np.zeros((len(faces), 3))
    for k, rings in enumerate(faces):
        rows = np.column_stack((rings[0][:, :2] - middle, np.ones(len(rings[0]))))
        planes[k] = np.linalg.lstsq(rows, rings[0][:, 2], rcond=None)[0]
    planes[:, 2] -= planes[:, :2] @ middle
    return FoundRoof(np.array(polygons, object), planes, shapely.union_all(shapely.buffer(list(ground), 0)))


def compare_roof(truth: Mapping[str, Any], found: FoundRoof) -> Comparison:
    """Hold a roof against its truth.

    Parameters
    ----------
    truth : mapping
        A line of the ``truth.jsonl`` of a town.
    found : FoundRoof
        The same house in a city model.
    """
    x0, y0 = truth["origin"]
    main, others = truth["planes"][: truth["main"]], truth["planes"][truth["main"] :]
    rings = [_plan(plane) for plane in main]
    body = shapely.union_all(rings, grid_size=0.001)
    hidden = shapely.union_all([_plan(plane) for plane in others], grid_size=0.001)
    tree = shapely.STRtree(found.faces)
    angles, errors = [], [np.empty(0)]
    for plane, ring in zip(main, rings, strict=True):
        a, b, c = plane["plane"]
        true = np.array([a, b, c - a * x0 - b * y0])
        west, south, east, north = ring.bounds
        places = np.stack(np.meshgrid(np.arange(west, east, STEP), np.arange(south, north, STEP)), axis=-1)
        places = places.reshape(-1, 2)
        places = places[shapely.contains_xy(ring.difference(hidden).buffer(-0.1), *places.T)]
        point, face = tree.query(shapely.points(places), "intersects")
        if not len(point):
            continue
        z = (found.planes[face, :2] * places[point]).sum(axis=1) + found.planes[face, 2]
        errors.append(z - places[point] @ true[:2] - true[2])
        angles.append(_angle_between(found.planes[np.argmax(np.bincount(face))], true))
    outline = shapely.Polygon(truth["outline"])
    return Comparison(
        truth["type"],
        _name_type(found, body) == truth["type"],
        _count_planes(found) == len(truth["planes"]),
        np.array(angles),
        outline.symmetric_difference(found.outline).area / outline.length,
        np.concatenate(errors),
    )


def summarise_roofs(compared: Sequence[Comparison], lost: Mapping[str, int]) -> list[dict[str, Any]]:
    """Summarise comparisons by type of the main roof, and of all.

    Parameters
    ----------
    compared : sequence of Comparison
        Of houses that the city model has.
    lost : mapping of str to int
        How many of each type it lacks.

    Returns
    -------
    list of dict
        ``type``, ``houses``, ``lost``; ``right_type`` and ``right_planes`` as shares; ``angle_50`` and
        ``angle_95`` (degrees); ``outline``, ``height_50`` (of absolute errors) and ``height_rmse`` (m).
    """
    rows = []
    for kind in TYPES:
        told = [one for one in compared if kind in (one.kind, "all")]
        gone = sum(lost.values()) if kind == "all" else lost.get(kind, 0)
        if not told and not gone:
            continue
        row: dict[str, Any] = {"type": kind, "houses": len(told), "lost": gone}
        angles, errors = (np.concatenate([np.empty(0), *arrays]) for arrays in _arrays_of(told))
        if len(angles) and len(errors):
            row |= {
                "right_type": float(np.mean([one.same_type for one in told])),
                "right_planes": float(np.mean([one.same_planes for one in told])),
                "angle_50": float(np.median(angles)),
                "angle_95": float(np.percentile(angles, 95)),
                "outline": float(np.median([one.outline for one in told])),
                "height_50": float(np.median(np.abs(errors))),
                "height_rmse": float(np.sqrt(np.mean(errors**2))),
            }
        rows.append(row)
    return rows


def _arrays_of(told: Sequence[Comparison]) -> tuple[list[Array], list[Array]]:
    return [one.angles for one in told], [one.errors for one in told]


def _plan(plane: Mapping[str, Any]) -> shapely.Polygon:
    return shapely.Polygon([corner[:2] for corner in plane["ring"]])


def _angle_between(one: Array, other: Array) -> float:
    a, b = np.array([*one[:2], -1.0]), np.array([*other[:2], -1.0])
    return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def _count_planes(found: FoundRoof) -> int:
    """Count the different planes of a roof."""
    kept: list[Array] = []
    for polygon, plane in zip(found.faces, found.planes, strict=True):
        inside = polygon.representative_point()
        place = np.array([inside.x, inside.y, 1.0])
        if not any(
            _angle_between(plane, other) < SAME_ANGLE and abs((plane - other) @ place) < SAME_HEIGHT
            for other in kept
        ):
            kept.append(plane)
    return len(kept)


def _name_type(found: FoundRoof, body: shapely.Geometry) -> str:
    """Name the type of the main roof by its planes over the main body."""
    area = shapely.area(shapely.intersection(shapely.buffer(found.faces, 0), body))
    planes: list[list[Any]] = []
    for plane, size in zip(found.planes, area, strict=True):
        near = next((one for one in planes if _angle_between(one[0], plane) < 2 * SAME_ANGLE), None)
        if near is None:
            planes.append([plane, size])
        else:
            near[1] += size
    level = np.zeros(3)
    sloped = [plane for plane, size in planes if size > MAIN * body.area and _angle_between(plane, level) > SLOPED]
    if len(sloped) < 2:
        return "shed" if sloped else "flat"
    if len(sloped) == 2:
        return "gabled" if sloped[0][:2] @ sloped[1][:2] < 0 else "other"
    if len(sloped) != 4:
        return "other"
    centre = np.array([body.centroid.x, body.centroid.y])
    rows = np.array([[*plane[:2], -1.0, -(plane[2] + plane[:2] @ centre)] for plane in sloped])
    tip = np.linalg.lstsq(rows[:, :3], rows[:, 3], rcond=None)[0]
    return "pyramidal" if np.abs(rows[:, :3] @ tip - rows[:, 3]).max() < POINT else "hipped"
