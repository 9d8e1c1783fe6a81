"""Zones of detail as options and files: what is read of them, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely

from pipeline.data.errors import CityError, ConfigError
from tiler.config.config import Config, idle_parameters, make_config
from tiler.config.zone_levels import describe_zones, find_levels, read_described
from tiler.config.zones import LEVELS
from tiler.planning.lod_zones import check_generalised, describe_absent, read_zones
from tiler.planning.refinements import read_refinements
from tiler.planning.region import Region

REGION = Region((318_000.0, 6_399_000.0, 319_000.0, 6_400_000.0), "EPSG:3006", 1000.0)
X, Y = 318_500.0, 6_399_500.0


def write_zones(
    path: Path, levels: list[Any], sizes: list[Any], *, crs: str | None = "EPSG:3006", layer: str = "zones"
) -> None:
    """Squares of 100, 200, ... m around one place."""
    shapes = [shapely.box(X - side, Y - side, X + side, Y + side) for side in 50.0 * np.arange(1, len(levels) + 1)]
    data = [np.array(levels, object), np.array(sizes, object)]
    wkb = np.array(shapely.to_wkb(shapes), object)
    pyogrio.raw.write(
        path, wkb, data, ["level", "size"], geometry_type="Polygon", crs=crs, layer=layer, append=path.exists()
    )


def test_the_finest_zone_of_a_place_counts(tmp_path: Path) -> None:
    write_zones(tmp_path / "zones.gpkg", ["1.3", "2.2"], ["5", "8"])
    config = make_config(
        {"lod_zones": [f"{X},{Y},300,1.2,10", "rest,1.2", str(tmp_path / "zones.gpkg")], "mesh_size": 20.0}
    )
    zones = read_zones(config, REGION)
    assert [zone[:2] for zone in zones] == [("2.2", 8.0), ("1.3", 5.0), ("1.2", 10.0), ("1.2", 20.0)]
    places = X + np.array([0.0, 75, 120, 400]), np.full(4, Y)
    assert [LEVELS[k] for k in find_levels(zones, np.column_stack(places))] == ["2.2", "2.2", "1.2", "1.2"]
    assert [size for size, _ in read_refinements(config, REGION, zones)] == [5.0, 8.0, 10.0]
    assert read_described(describe_zones(zones)) == zones
    assert read_zones(Config(), REGION) == ()
    assert (config.zoned, config.finest_size, make_config({"focus": "1,2,3"}).finest_size) == (True, 10.0, 2.5)
    assert idle_parameters(make_config({"generalised": "blocks.gpkg"})) == [
        "generalised has no effect: it counts with lod_zones, focus"
    ]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"focus": "1,2"}, "focus = 1,2: x,y,RADIUS expected"),
        ({"focus": "1,2,0"}, "a radius of 0 m; must be above 0"),
        ({"focus": "1,2,nan"}, "x,y,RADIUS expected"),
        ({"focus": "1,2,9,11"}, "a size of 11 m; must be at least 0.1 m and at most that of the rest"),
        ({"lod_zones": ["1,2,9,2.1,5"]}, "level '2.1'; must be one of 2.2, 1.3, 1.2, 0C, 0B, 0A"),
        ({"lod_zones": ["1,2,9,2.2"]}, "a circle x,y,RADIUS,LEVEL,SIZE, or rest,LEVEL"),
        ({"lod_zones": ["rest,1.2", "rest,1.3"]}, "lod_zones = rest,1.3: the rest has a level already"),
        ({"lod_zones": ["rest,0B"]}, "level 0B takes blocks of generalised buildings; make them with"),
        ({"focus": "1,2,3", "roofs": "flat"}, "roofs = flat.*level 2.2 has sloped roofs; give --roofs planes"),
    ],
)
def test_wrong_zones_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_config(values)


@pytest.mark.filterwarnings("ignore:.crs. was not provided")
def test_a_layer_of_a_file_without_a_crs_is_told(tmp_path: Path) -> None:
    for layer, level in (("focus", "2.2"), ("rest", "1.2")):
        write_zones(tmp_path / "zones.gpkg", [level], ["5"], crs=None, layer=layer)
    told: list[str] = []
    config = make_config({"lod_zones": [f"{tmp_path}/zones.gpkg:rest"]})
    assert [level for level, *_ in read_zones(config, REGION, told.append)] == ["1.2", "2.2"]
    assert told == ["zones.gpkg: states no CRS, taken as EPSG:3006"]
    with pytest.raises(ConfigError, match=r"has 2 layers.* write lod_zones = .*zones.gpkg:LAYER"):
        read_zones(make_config({"lod_zones": [f"{tmp_path}/zones.gpkg"]}), REGION)


def test_zones_outside_of_the_region_are_told(tmp_path: Path) -> None:
    inside, swapped = f"{X},{Y},50,2.2,5", f"{Y},{X},50,1.3,5"
    zones = read_zones(make_config({"lod_zones": [inside, swapped]}), REGION)
    (said,) = describe_absent(zones, REGION)
    assert said.startswith("1 of 2 zones lie outside of the region, the first one at 6399500, 318500: ")
    assert describe_absent(read_zones(make_config({"lod_zones": [inside]}), REGION), REGION) == []


def test_blocks_need_their_layers_before_anything_is_read(tmp_path: Path) -> None:
    write_zones(tmp_path / "other.gpkg", ["1.2"], ["5"])
    config = make_config({"lod_zones": ["rest,0B"], "generalised": str(tmp_path / "other.gpkg")})
    with pytest.raises(CityError, match="has no layer 'cells'"):
        check_generalised(config, read_zones(config, REGION))


@pytest.mark.parametrize(
    ("levels", "sizes", "message"),
    [
        (["9"], ["5"], "feature 1: level '9'; must be one of"),
        (["1.2"], ["50"], "feature 1: a size of 50 m; must be at least 0.1 m and at most that of the rest"),
        (["1.2"], [""], "feature 1: a level, a size in metres and an area expected"),
        (["0C"], ["5"], "feature 1: level 0C takes blocks"),
    ],
)
def test_wrong_zones_of_a_file_are_refused(tmp_path: Path, levels: Any, sizes: Any, message: str) -> None:
    write_zones(tmp_path / "zones.gpkg", levels, sizes)
    config = make_config({"lod_zones": [str(tmp_path / "zones.gpkg")]})
    with pytest.raises(CityError, match=message):
        read_zones(config, REGION)
    with pytest.raises(CityError, match="no such file; check the path of lod_zones"):
        read_zones(make_config({"lod_zones": ["none.gpkg"]}), REGION)
