"""CityGML 1.0 to 3.0: boundary surfaces, solids with links, parts, units; and hostile XML."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.data.errors import InputError
from tests.tiler.cityinput.models import FACES, house_gml, polygon_gml, write_gml
from tiler.cityinput.citygml import scan_citygml
from tiler.cityinput.faces import GROUND, OUTLINE, ROOF, UNKNOWN, WALL, ModelBuilding


def buildings_of(path: Path) -> list[ModelBuilding]:
    return [each for each in scan_citygml(path) if isinstance(each, ModelBuilding)]


def solid_of(members: str, lod: int = 2) -> str:
    return (
        f"<bldg:lod{lod}Solid><gml:Solid><gml:exterior><gml:CompositeSurface>{members}</gml:CompositeSurface>"
        f"</gml:exterior></gml:Solid></bldg:lod{lod}Solid>"
    )


def member(content: str) -> str:
    return f"<gml:surfaceMember>{content}</gml:surfaceMember>"


def building(content: str, name: str = "a") -> str:
    return f"<cityObjectMember><bldg:Building gml:id='{name}'>{content}</bldg:Building></cityObjectMember>"


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_boundary_surfaces_are_the_faces_of_a_building(tmp_path: Path, version: str) -> None:
    (house,) = buildings_of(write_gml(tmp_path / "a.gml", house_gml(), version=version))
    (shape,) = house.shapes
    assert (house.id, house.height, shape.lod, shape.closed) == ("house", 7.0, 2.0, False)
    assert shape.faces.kind.tolist() == [GROUND, ROOF, ROOF, WALL, WALL, WALL, WALL]
    assert shape.faces.xyz[:4].tolist() == [
        [100_000.0 + x, 450_000.0 + y, 2.0] for x, y in ((0, 0), (0, 8), (10, 8), (10, 0))
    ]


def test_version_3_has_other_names(tmp_path: Path) -> None:
    content = (
        "<cityObjectMember><bldg:Building gml:id='a'><boundary><con:RoofSurface><lod2MultiSurface>"
        "<gml:MultiSurface>"
        f"{member(polygon_gml(FACES['RoofSurface'][0]))}</gml:MultiSurface></lod2MultiSurface></con:RoofSurface>"
        "</boundary><con:height><con:Height><con:value uom='m'>7.5</con:value></con:Height></con:height>"
        "<bldg:buildingPart><bldg:BuildingPart gml:id='b'><boundary><con:RoofSurface><lod2MultiSurface>"
        f"<gml:MultiSurface>{member(polygon_gml(FACES['RoofSurface'][1]))}</gml:MultiSurface></lod2MultiSurface>"
        "</con:RoofSurface></boundary></bldg:BuildingPart></bldg:buildingPart></bldg:Building></cityObjectMember>"
    )
    (house,) = buildings_of(write_gml(tmp_path / "a.gml", content, version="3.0"))
    assert house.height == 7.5
    assert [(shape.owner, shape.faces.kind.tolist()) for shape in house.shapes] == [("a", [ROOF]), ("b", [ROOF])]


def test_links_of_a_solid_to_its_boundary_surfaces_are_not_read_twice(tmp_path: Path) -> None:
    roof = polygon_gml(FACES["RoofSurface"][0], "p1")
    content = building(
        solid_of("<gml:surfaceMember xlink:href='#p1'/>")
        + "<bldg:boundedBy><bldg:RoofSurface><bldg:lod2MultiSurface><gml:MultiSurface>"
        + f"{member(roof)}</gml:MultiSurface></bldg:lod2MultiSurface></bldg:RoofSurface></bldg:boundedBy>"
    )
    (house,) = buildings_of(write_gml(tmp_path / "a.gml", content))
    assert [len(shape.faces) for shape in house.shapes] == [1]
    assert house.faults == ()


def test_links_to_other_polygons_of_the_building_are_followed_and_lost_ones_told(tmp_path: Path) -> None:
    content = building(
        solid_of(member(polygon_gml(FACES["RoofSurface"][0], "p1")), 1)
        + solid_of("<gml:surfaceMember xlink:href='#p1'/><gml:surfaceMember xlink:href='#none'/>")
    )
    (house,) = buildings_of(write_gml(tmp_path / "a.gml", content))
    assert [(shape.lod, len(shape.faces)) for shape in house.shapes] == [(1.0, 1), (2.0, 1)]
    assert house.faults == ("a: xlink to #none, which is not in the building",)


def test_one_id_at_several_surfaces_loses_none(tmp_path: Path) -> None:
    surfaces = "".join(
        "<bldg:boundedBy><bldg:RoofSurface gml:id='same'><bldg:lod2MultiSurface><gml:MultiSurface>"
        f"{member(polygon_gml(ring, 'twice'))}</gml:MultiSurface></bldg:lod2MultiSurface></bldg:RoofSurface>"
        "</bldg:boundedBy>"
        for ring in FACES["RoofSurface"]
    )
    solid = solid_of("<gml:surfaceMember xlink:href='#twice'/>")
    (house,) = buildings_of(write_gml(tmp_path / "a.gml", building(solid + surfaces)))
    assert [(len(shape.faces), shape.closed) for shape in house.shapes] == [(2, False)]


def test_twelve_parts_are_twelve_parts(tmp_path: Path) -> None:
    parts = "".join(
        f"<bldg:consistsOfBuildingPart><bldg:BuildingPart gml:id='p{k}'>"
        f"{solid_of(member(polygon_gml(FACES['RoofSurface'][0])))}</bldg:BuildingPart></bldg:consistsOfBuildingPart>"
        for k in range(12)
    )
    (house,) = buildings_of(write_gml(tmp_path / "a.gml", building(parts)))
    assert [shape.owner for shape in house.shapes] == [f"p{k}" for k in range(12)]
    assert all(shape.faces.kind.tolist() == [UNKNOWN] for shape in house.shapes)


def test_cavities_of_solids_are_left_out(tmp_path: Path) -> None:
    shell = f"<gml:CompositeSurface>{member(polygon_gml(FACES['GroundSurface'][0]))}</gml:CompositeSurface>"
    inner = f"<gml:interior>{shell}</gml:interior>"
    outer = solid_of(member(polygon_gml(FACES["RoofSurface"][0])))
    (house,) = buildings_of(
        write_gml(tmp_path / "a.gml", building(outer.replace("</gml:Solid>", f"{inner}</gml:Solid>")))
    )
    assert [len(shape.faces) for shape in house.shapes] == [1]


@pytest.mark.parametrize(
    ("unit", "height"), [("", 10.0), (" uom='m'", 10.0), (" uom='#m'", 10.0), (" uom='ft'", 3.048)]
)
def test_units_of_heights(tmp_path: Path, unit: str, height: float) -> None:
    (house,) = buildings_of(
        write_gml(tmp_path / "a.gml", building(f"<bldg:measuredHeight{unit}>10</bldg:measuredHeight>"))
    )
    assert house.height == pytest.approx(height)


@pytest.mark.parametrize(
    "ring",
    [
        "<gml:pos>1 2 3</gml:pos><gml:pos>4 2 3</gml:pos><gml:pos>4 6 3</gml:pos><gml:pos>1 2 3</gml:pos>",
        "<gml:coordinates>1,2,3 4,2,3 4,6,3 1,2,3</gml:coordinates>",
        "<gml:posList>1 2 3 4 2 3 4 6 3 1 2 3</gml:posList>",
        "<gml:pointProperty><gml:Point><gml:pos>1 2 3</gml:pos></gml:Point></gml:pointProperty>"
        "<gml:pos>4 2 3</gml:pos><gml:pos>4 6 3</gml:pos><gml:pos>1 2 3</gml:pos>",
    ],
)
def test_all_ways_to_write_a_ring(tmp_path: Path, ring: str) -> None:
    polygon = f"<gml:Polygon><gml:exterior><gml:LinearRing>{ring}</gml:LinearRing></gml:exterior></gml:Polygon>"
    (house,) = buildings_of(write_gml(tmp_path / "a.gml", building(solid_of(member(polygon)))))
    assert house.shapes[0].faces.xyz.tolist() == [[1, 2, 3], [4, 2, 3], [4, 6, 3]]


def test_a_polygon_with_wrong_numbers_is_told(tmp_path: Path) -> None:
    ring = "<gml:LinearRing><gml:posList>1 2 3 4</gml:posList></gml:LinearRing>"
    polygon = f"<gml:Polygon gml:id='p'><gml:exterior>{ring}</gml:exterior></gml:Polygon>"
    (house,) = buildings_of(write_gml(tmp_path / "a.gml", building(solid_of(member(polygon)))))
    assert house.faults == ("polygon p cannot be read (4 numbers in rows of 3)",)


def test_footprints_and_edges_of_roofs_are_outlines(tmp_path: Path) -> None:
    flat = f"<gml:MultiSurface>{member(polygon_gml(FACES['GroundSurface'][0]))}</gml:MultiSurface>"
    content = building(
        f"<bldg:lod0FootPrint>{flat}</bldg:lod0FootPrint><bldg:lod0RoofEdge>{flat}</bldg:lod0RoofEdge>"
    )
    (house,) = buildings_of(write_gml(tmp_path / "a.gml", content))
    assert np.concatenate([shape.faces.kind for shape in house.shapes]).tolist() == [OUTLINE, OUTLINE]


def test_entities_are_not_expanded(tmp_path: Path) -> None:
    bomb = "<!DOCTYPE x [<!ENTITY a 'aaaaaaaaaa'><!ENTITY b '&a;&a;&a;&a;&a;&a;&a;&a;'>]>"
    secret = tmp_path / "secret"
    secret.write_text("7")
    outside = f"<!DOCTYPE x [<!ENTITY a SYSTEM '{secret.as_uri()}'>]>"
    for before, entity in ((bomb, "&b;"), (outside, "&a;")):
        content = building(f"<bldg:measuredHeight>{entity}</bldg:measuredHeight>")
        (house,) = buildings_of(write_gml(tmp_path / "a.gml", content, before=before))
        assert np.isnan(house.height)


def test_a_file_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    path = write_gml(tmp_path / "a.gml", house_gml())
    path.write_text(path.read_text()[:-60])
    with pytest.raises(InputError, match="no sound XML"):
        buildings_of(path)
