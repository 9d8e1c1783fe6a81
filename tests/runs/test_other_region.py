"""The folder of another region's run is not touched, and a refused run leaves no folder."""

import json
from pathlib import Path

import pytest

from pipeline.data.errors import ConfigError
from tests.helpers.bad_input import QUICK, call, write_city, write_cloud
from tests.helpers.cities import cloud_over
from tests.helpers.tiles import hash_files
from tiler.planning.region import Region
from tiler.workflow.other_region import refuse_other_region

Capture = pytest.CaptureFixture[str]
BOX = (318_000.0, 6_399_000.0, 318_060.0, 6_399_060.0)


def write_record(
    folder: Path, *, bounds: tuple[float, ...] = BOX, crs: str = "EPSG:3006", status: str = "done"
) -> Path:
    given = {"pointcloud": ["/a/one.laz"], "footprints": ""}
    record = {"schema": 1, "status": status, "region": {"bounds": bounds, "crs": crs}, "parameters": given}
    (folder / "run.json").write_text(json.dumps(record))
    return folder


@pytest.mark.parametrize(
    ("region", "inputs", "words"),
    [
        ((318_500.0, 6_399_000.0, 318_560.0, 6_399_060.0), ["/a/one.laz"], "have no area in common"),
        (
            (318_050.0, 6_399_000.0, 318_110.0, 6_399_060.0),
            ["/b/two.laz"],
            "17 % of their area and no file in common",
        ),
        ((318_050.0, 6_399_000.0, 318_110.0, 6_399_060.0), ["/a/one.laz"], ""),  # another part of the same files
        (BOX, ["/b/two.laz"], ""),  # newer files of the same region
    ],
)
def test_what_is_another_region(
    tmp_path: Path, region: tuple[float, float, float, float], inputs: list[str], words: str
) -> None:
    write_record(tmp_path)
    now = Region(region, "EPSG:3006", 500.0)
    if not words:
        refuse_other_region(tmp_path, now, inputs)
        return
    with pytest.raises(ConfigError, match=words) as caught:
        refuse_other_region(tmp_path, now, inputs)
    assert "--overwrite" in str(caught.value)


def test_another_crs_is_another_region(tmp_path: Path) -> None:
    write_record(tmp_path)
    refuse_other_region(tmp_path, Region(BOX, "EPSG:3006", 500.0), [])
    with pytest.raises(ConfigError, match="in EPSG:3006; this one is in EPSG:3007"):
        refuse_other_region(tmp_path, Region(BOX, "EPSG:3007", 500.0), ["/a/one.laz"])


@pytest.mark.parametrize("status", ["failed", "stopped", "running"])
def test_a_run_that_did_not_end_is_gone_on_with(tmp_path: Path, status: str) -> None:
    write_record(tmp_path, status=status, crs="EPSG:3007")
    refuse_other_region(tmp_path, Region(BOX, "EPSG:3006", 500.0), [])


def test_a_folder_without_a_sound_record_is_nobodys(tmp_path: Path) -> None:
    refuse_other_region(tmp_path, Region(BOX, "EPSG:3006", 500.0), [])
    (tmp_path / "run.json").write_text('{"status": "done", "region": 7}')
    refuse_other_region(tmp_path, Region(BOX, "EPSG:3006", 500.0), [])


def test_a_run_of_another_region_leaves_the_folder_as_it_is(tmp_path: Path, capsys: Capture) -> None:
    city = write_city(tmp_path / "city")
    out = tmp_path / "out"
    assert call(capsys, "run", city / "cloud.laz", "--out", out, *QUICK).code == 0
    before = hash_files(out)
    cloud = cloud_over((319_000.0, 6_399_000.0, 319_060.0, 6_399_060.0), [], ground=2.0)
    other = write_cloud(tmp_path / "other.laz", cloud.xyz, cloud.classification)
    found = call(capsys, "run", other, "--out", out, *QUICK)
    assert found.code == 2
    assert "holds the run of another region" in found.err
    assert hash_files(out) == before
    assert call(capsys, "run", other, "--out", out, *QUICK, "--overwrite").code == 0
    assert hash_files(out) != before


@pytest.mark.parametrize("wrong", [["--crs", "EPSG:1"], ["--footprints", "nowhere.gpkg"], ["--bounds", *"0123"]])
def test_a_refused_run_leaves_no_folder(tmp_path: Path, capsys: Capture, wrong: list[str]) -> None:
    city = write_city(tmp_path / "city")
    assert call(capsys, "run", city / "cloud.laz", "--out", tmp_path / "new" / "out", *wrong).code in (1, 2)
    assert not (tmp_path / "new").exists()


def test_a_run_that_fails_before_a_cloud_is_read_leaves_no_folder(tmp_path: Path, capsys: Capture) -> None:
    city = write_city(tmp_path / "city")
    cloud = city / "cloud.laz"
    data = bytearray(cloud.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 200] = b"\xff" * 200
    cloud.write_bytes(data)
    assert call(capsys, "run", cloud, "--out", tmp_path / "new" / "out", *QUICK).code == 1
    assert not (tmp_path / "new").exists()
    (tmp_path / "old").mkdir()
    assert call(capsys, "run", cloud, "--out", tmp_path / "old", *QUICK).code == 1
    assert json.loads((tmp_path / "old" / "run.json").read_text())["status"] == "failed"


def test_a_folder_that_was_there_stays(tmp_path: Path, capsys: Capture) -> None:
    city = write_city(tmp_path / "city")
    (tmp_path / "out").mkdir()
    assert call(capsys, "run", city / "cloud.laz", "--out", tmp_path / "out", "--crs", "EPSG:1").code == 2
    assert list((tmp_path / "out").iterdir()) == []
