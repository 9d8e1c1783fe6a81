"""Countries to simulate: their outlines, drawn by hand, and point-cloud files as sheets over them."""

import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS

ROUGHNESS = 0.12  # of the length of a side; how far its middle is put aside, and so on with the halves
HALVINGS = 5
BOUNDS = 179  # byte of the bounds in a LAS header: xmax, xmin, ymax, ymin, zmax, zmin

# Kilometres in RD (EPSG:28992) and SWEREF 99 TM (EPSG:3006), right within some ten.
NETHERLANDS = (
    "15 378,20 398,38 415,55 430,67 443,78 457,90 472,97 487,101 498,104 515,108 545,111 553,112 565,"
    "116 582,123 585,135 595,156 600,185 608,207 611,235 614,250 608,258 595,272 585,277 578,276 565,"
    "269 545,266 530,247 520,243 510,242 500,260 495,268 482,264 470,252 462,246 452,247 445,238 437,"
    "225 432,212 428,203 428,198 424,195 410,203 400,211 378,208 368,205 360,197 355,190 342,195 335,"
    "203 322,199 307,187 306,177 307,174 318,181 335,186 352,178 358,172 360,165 363,158 366,148 368,"
    "138 372,130 383,123 383,118 390,105 382,97 388,88 388,80 380,75 370,62 365,50 360,43 368,30 366"
)
SWEDEN = (
    "366 6140,372 6165,357 6215,365 6250,365 6285,335 6330,320 6370,312 6400,300 6440,290 6490,281 6540,"
    "292 6555,310 6565,330 6600,332 6640,350 6690,350 6740,375 6760,370 6800,365 6850,345 6885,350 6920,"
    "350 6960,340 6995,345 7030,370 7060,400 7080,435 7120,460 7160,465 7240,495 7300,490 7330,530 7380,"
    "540 7430,560 7450,580 7500,600 7560,625 7600,660 7630,705 7672,740 7640,790 7610,830 7570,860 7530,"
    "870 7500,880 7470,890 7430,905 7390,915 7320,870 7310,830 7280,800 7250,795 7210,800 7180,790 7120,"
    "770 7075,730 7050,690 7020,670 6980,645 6945,640 6930,620 6920,625 6880,618 6845,615 6790,620 6730,"
    "660 6710,690 6690,715 6670,725 6630,718 6600,715 6570,675 6530,620 6510,600 6460,600 6400,595 6350,"
    "590 6310,585 6280,570 6240,535 6220,490 6225,450 6200,445 6180,460 6155,425 6140,395 6137"
)
GOTLAND = "690 6320,685 6360,700 6400,720 6425,745 6430,730 6400,720 6370,712 6340"
OELAND = "600 6270,602 6300,615 6350,625 6360,615 6310,606 6260"


@dataclass(frozen=True)
class Country:
    """A country and its survey."""

    #: name, and code of the CRS
    name: str
    crs: str
    outlines: tuple[str, ...]  #: corners of its polygons (km)
    n_tiles: int  #: tiles that it has: the outline is scaled to that area
    tile_size: float  #: side of a tile (m)
    sheet: tuple[float, float]  #: sides of a point-cloud file (m)


COUNTRIES = {
    "netherlands": Country("the Netherlands", "EPSG:28992", (NETHERLANDS,), 170_000, 500.0, (1000.0, 1250.0)),
    "sweden": Country("Sweden", "EPSG:3006", (SWEDEN, GOTLAND, OELAND), 450_000, 1000.0, (2500.0, 2500.0)),
}


def outline(country: Country, n_tiles: int) -> shapely.Geometry:
    """Make the outline of a country, roughened as coasts are, with the area of so many tiles (m)."""
    random = np.random.default_rng(1)
    polygons = []
    for text in country.outlines:
        xy = np.array([[float(v) for v in point.split()] for point in text.split(",")])
        polygons.append(shapely.make_valid(shapely.polygons(_roughen(1000 * xy, random))))
    whole = shapely.union_all(polygons)
    scale = np.sqrt(n_tiles * country.tile_size**2 / shapely.area(whole))
    low = shapely.bounds(whole)[:2]
    return shapely.transform(whole, lambda xy: low + (xy - low) * scale)


def sheets(country: Country, n_tiles: int) -> NDArray[np.float64]:
    """Boxes of the point-cloud files: those of a grid that meet the country: float64, (n, 4) (m).

    Tiles that a sheet at the coast covers count too, so there are a few more tiles than asked for.
    """
    shape = outline(country, n_tiles)
    shapely.prepare(shape)
    size = np.array(country.sheet)
    low, high = np.array(shapely.bounds(shape)).reshape(2, 2)
    columns, rows = (np.arange(a // s, b // s + 1) for a, b, s in zip(low, high, size, strict=True))
    corner = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1).reshape(-1, 2) * size
    boxes = np.hstack((corner, corner + size))
    found: NDArray[np.float64] = boxes[shapely.contains_xy(shape, *(corner + size / 2).T)]
    return found


def write_sheets(boxes: NDArray[np.float64], crs: str, folder: Path) -> None:
    """Write a LAS file with one point for each box, whose header says that the box is full."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "one.las"
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.add_crs(CRS.from_user_input(crs))
        header.scales = np.full(3, 0.01)
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = np.array([0.0]), np.array([0.0]), np.array([0.0])
        cloud.write(path)
        content = bytearray(path.read_bytes())
    for xmin, ymin, xmax, ymax in boxes.tolist():
        struct.pack_into("<6d", content, BOUNDS, xmax, xmin, ymax, ymin, 50.0, 0.0)
        (folder / f"{xmin:.0f}_{ymin:.0f}.las").write_bytes(content)


def _roughen(xy: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.float64]:
    """Put the middle of each side aside, and those of the halves."""
    for _ in range(HALVINGS):
        side = np.roll(xy, -1, axis=0) - xy
        aside = side[:, ::-1] * [-1.0, 1.0] * random.uniform(-ROUGHNESS, ROUGHNESS, (len(xy), 1))
        xy = np.stack((xy, xy + side / 2 + aside), axis=1).reshape(-1, 2)
    return xy
