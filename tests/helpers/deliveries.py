"""Point clouds as agencies deliver them, of one small town made in code: formats, classes, CRS records."""

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyogrio
import pyproj
import shapely
from laspy.vlrs.known import GeoAsciiParamsVlr, GeoDoubleParamsVlr, GeoKeyDirectoryVlr, WktCoordinateSystemVlr
from numpy.typing import NDArray

SIDE = 120.0  # m
# xmin, ymin, xmax, ymax and height above the ground (m)
HOUSES = (
    *((15, 15, 27, 25, 6.0), (40, 12, 52, 30, 9.0), (70, 15, 84, 27, 12.0), (95, 14, 108, 30, 7.5)),
    *((15, 50, 30, 62, 8.0), (42, 48, 56, 64, 15.0), (70, 50, 82, 66, 6.5), (92, 52, 106, 62, 10.0)),
    *((18, 86, 32, 100, 5.5), (44, 84, 58, 102, 20.0), (72, 86, 86, 100, 7.0), (94, 86, 108, 104, 11.0)),
)
TREES = ((35, 40), (62, 40), (88, 75), (36, 76))
TREE_RADIUS, TREE_LOW, TREE_HIGH = 4.0, 3.0, 9.0  # m
WATER_EDGE = 112.0  # m; a canal along the eastern side
GROUND_HEIGHT = 30.0  # m
FEET, SURVEY_FEET = 0.3048, 1200 / 3937  # m

Array = NDArray[np.float64]
Points = NDArray[np.void]  # fields x, y, z and what: "ground", "roof", "tree", "water", "wall" or "noise"
Keys = dict[int, int | float | str]


def ground(x: Array, y: Array) -> Array:
    """Height of the ground (m)."""
    return np.asarray(GROUND_HEIGHT + 0.01 * x + 0.3 * np.sin(y / 25.0), np.float64)


def house_of(xyz: Array) -> NDArray[np.int64]:
    """House in whose outline each point lies, in metres from the town's corner; -1 for none."""
    house = np.full(len(xyz), -1)
    for k, (a, b, c, d, _) in enumerate(HOUSES):
        house[(xyz[:, 0] > a) & (xyz[:, 0] < c) & (xyz[:, 1] > b) & (xyz[:, 1] < d)] = k
    return house


def scan(step: float = 0.8) -> tuple[Array, NDArray[np.str_]]:
    """Points of the town, (n, 3) in metres from its corner, and what each lies on."""
    rng = np.random.default_rng(7)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, SIDE, step), np.arange(0, SIDE, step)))
    x, y = (axis + rng.uniform(0, step, axis.size) for axis in (x, y))
    z, what = ground(x, y), np.full(len(x), "ground")
    what[x > WATER_EDGE] = "water"
    z[x > WATER_EDGE] = GROUND_HEIGHT
    for a, b, c, d, height in HOUSES:
        inside = (x > a) & (x < c) & (y > b) & (y < d)
        z[inside] = ground(np.array((a + c) / 2), np.array((b + d) / 2)) + height
        what[inside] = "roof"
    z += rng.normal(0, 0.02, len(z))
    n = int(50 / step**2)
    crowns = []
    for tree_x, tree_y in TREES:
        angle, far = rng.uniform(0, 2 * np.pi, n), TREE_RADIUS * np.sqrt(rng.random(n))
        crown = np.column_stack((tree_x + far * np.cos(angle), tree_y + far * np.sin(angle)))
        crowns.append(np.column_stack((crown, ground(*crown.T) + rng.uniform(TREE_LOW, TREE_HIGH, n))))
    clutter = [(*rng.uniform(0, SIDE, 2), -40.0 if k % 2 else 400.0) for k in range(20)]
    parts = [np.column_stack((x, y, z)), *crowns, np.array(clutter)]
    labels = [what, np.full(n * len(TREES), "tree"), np.full(len(clutter), "noise")]
    return np.concatenate(parts), np.concatenate(labels)


@dataclass(frozen=True)
class Delivery:
    """How an agency delivers."""

    classes: dict[str, int]  #: class of what is ``"ground"``, ``"roof"``, ``"tree"``, ``"water"`` and ``"noise"``
    #: as in the header
    point_format: int = 6
    version: str = "1.4"
    crs: str = ""  #: CRS of the coordinates
    corner: tuple[float, float] = (0.0, 0.0)  #: (x, y): corner of the town there, in units of the CRS
    record: str = "wkt"  #: how the file states the CRS: WKT 2 or 1, GeoTIFF keys, not at all
    keys: Keys = field(default_factory=dict)  #: GeoTIFF keys, by number
    suffix: str = ".laz"  #: of the file
    scale: float = 0.01  #: of the stored coordinates
    #: unit of coordinates and of heights (m)
    unit: float = 1.0
    unit_z: float = 1.0
    extra: tuple[str, ...] = ()  #: extra bytes, by name
    #: changes the points before they are written
    edit: Callable[[laspy.LasData, NDArray[np.str_]], None] | None = None
    options: dict[str, Any] = field(default_factory=dict)  #: further parameters that a run needs


def write_delivery(folder: Path, delivery: Delivery) -> dict[str, Any]:
    """Write cloud and footprints; returns what a configuration says of them."""
    folder.mkdir(parents=True, exist_ok=True)
    xyz, what = scan()
    place = xyz / (delivery.unit, delivery.unit, delivery.unit_z) + (*delivery.corner, 0.0)
    header = laspy.LasHeader(point_format=delivery.point_format, version=delivery.version)
    header.scales = np.full(3, delivery.scale)
    header.offsets = np.floor(place.min(axis=0))
    add_record(header, delivery)
    for name in delivery.extra:
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=np.uint16))
    las = laspy.LasData(header)
    las.x, las.y, las.z = place.T
    classes = np.array([delivery.classes[one] for one in what.tolist()], np.uint8)
    las.classification = classes
    las.return_number[:] = 1
    las.number_of_returns[:] = 1
    if delivery.edit is not None:
        delivery.edit(las, what)
    path = folder / f"cloud{delivery.suffix}"
    if delivery.suffix == ".copc.laz":
        write_copc(path, las, delivery)
    else:
        las.write(path)
    write_footprints(folder / "footprints.gpkg", delivery)
    return {"pointcloud": [str(path)], "footprints": str(folder / "footprints.gpkg"), **delivery.options}


def write_copc(path: Path, las: laspy.LasData, delivery: Delivery) -> None:
    """Write points as COPC, spread over three levels of the octree."""
    import copclib as copc

    xyz, classes, withheld = np.asarray(las.xyz), np.asarray(las.classification), np.asarray(las.withheld)
    side, levels = 512.0, 3
    corner = np.floor(xyz.min(axis=0)) - (1.0, 1.0, 0.0)
    scale = copc.Vector3(*[delivery.scale] * 3)
    wkt = pyproj.CRS(delivery.crs).to_wkt("WKT1_GDAL")
    writer = copc.FileWriter(str(path), copc.CopcConfigWriter(6, scale, copc.Vector3(*corner), wkt))
    info = writer.copc_config.copc_info
    info.halfsize, info.spacing = side / 2, 10.0
    info.center_x, info.center_y, info.center_z = (corner + side / 2).tolist()
    level = np.arange(len(xyz)) % levels
    rows = np.column_stack((level, np.floor((xyz - corner) / (side / 2.0 ** level[:, None])))).astype(int)
    for node in np.unique(rows, axis=0):
        points = copc.Points(writer.copc_config.las_header)
        for row in np.flatnonzero((rows == node).all(axis=1)).tolist():
            point = points.CreatePoint()
            point.x, point.y, point.z = xyz[row].tolist()
            point.classification, point.withheld = int(classes[row]), bool(withheld[row])
            point.return_number = point.number_of_returns = 1
            points.AddPoint(point)
        writer.AddNode(copc.VoxelKey(*node.tolist()), points)
    header = writer.copc_config.las_header
    header.min, header.max = copc.Vector3(*xyz.min(axis=0)), copc.Vector3(*xyz.max(axis=0))
    writer.Close()


def forget_chunk_size(path: Path) -> None:
    """Write 0 as chunk size into the LASzip record of a COPC file, where "variable" is 2^32 - 1."""
    data = bytearray(path.read_bytes())
    place = data.find(b"laszip encoded") - 2 + 54 + 12
    if struct.unpack_from("<I", data, place)[0] != 2**32 - 1:
        raise ValueError(f"{path}: no variable chunks")
    struct.pack_into("<I", data, place, 0)
    path.write_bytes(data)


def add_record(header: laspy.LasHeader, delivery: Delivery) -> None:
    """State the CRS as the delivery does."""
    if delivery.record in ("wkt", "wkt1"):
        version = "WKT1_GDAL" if delivery.record == "wkt1" else "WKT2_2019"
        header.vlrs.append(WktCoordinateSystemVlr(pyproj.CRS(delivery.crs).to_wkt(version)))
        header.global_encoding.wkt = True
    elif delivery.record == "keys":
        header.vlrs.extend(geokeys(delivery.keys))


def geokeys(keys: Keys) -> list[Any]:
    """Make the records of GeoTIFF keys."""
    doubles: list[float] = []
    ascii_text = ""
    rows = []
    for number, value in sorted(keys.items()):
        if isinstance(value, str):
            rows.append((number, 34737, len(value) + 1, len(ascii_text)))
            ascii_text += value + "|"
        elif isinstance(value, float):
            rows.append((number, 34736, 1, len(doubles)))
            doubles.append(value)
        else:
            rows.append((number, 0, 1, value))
    directory = GeoKeyDirectoryVlr()
    directory.parse_record_data(struct.pack(f"<{4 + 4 * len(rows)}H", 1, 1, 0, len(rows), *sum(rows, ())))
    records: list[Any] = [directory]
    if doubles:
        record = GeoDoubleParamsVlr()
        record.parse_record_data(struct.pack(f"<{len(doubles)}d", *doubles))
        records.append(record)
    if ascii_text:
        text = GeoAsciiParamsVlr()
        text.parse_record_data(ascii_text.encode() + b"\0")
        records.append(text)
    return records


def write_footprints(path: Path, delivery: Delivery) -> None:
    """Write the twelve houses in the plane CRS of the delivery."""
    x, y = delivery.corner
    boxes = [
        shapely.box(x + a / delivery.unit, y + b / delivery.unit, x + c / delivery.unit, y + d / delivery.unit)
        for a, b, c, d, _ in HOUSES
    ]
    crs = pyproj.CRS(delivery.crs)
    plane = crs.sub_crs_list[0] if crs.is_compound else crs
    pyogrio.raw.write(
        path,
        geometry=shapely.to_wkb(np.array(boxes, object)),
        field_data=[np.array([f"h{k:02d}" for k in range(len(boxes))])],
        fields=["id"],
        geometry_type="Polygon",
        crs=plane.to_wkt() if plane.to_epsg() is None else f"EPSG:{plane.to_epsg()}",
    )
