"""The report in a browser: headless Chromium by playwright-core, as `.ci/run` installs them."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tiler.cli.main import main

pytestmark = pytest.mark.long
SCRIPT = Path(__file__).resolve().parents[2] / "helpers" / "open_report.js"
VIEWS = ("desktop", "phone", "dark")


def open_report(page: Path, folder: Path) -> dict[str, Any]:
    """Open a page in three views; what it finds, and screenshots in a folder."""
    assert shutil.which("chromium"), "no chromium; apt-get install -y chromium"
    done = subprocess.run(
        ["node", str(SCRIPT), str(page), str(folder)], capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def check_page(found: dict[str, Any], *, tiles: int) -> None:
    assert sorted(found) == sorted(VIEWS)
    for view in found.values():
        assert view["said"] == []  # no error, no warning
        assert len(view["fetched"]) == 1  # the page itself
        assert view["wider"] <= 0  # nothing is cut off at the side
        assert (view["unnamed"], view["scripts"], view["ids"]) == (0, 0, 0)
        assert [link for link in view["links"] if not link[1]] == []
        assert [link[0][1:] for link in view["links"]] == view["sections"]
        assert len(view["sections"]) == 9
        assert [one["tiles"] for one in view["maps"]] == [tiles] * 3  # by quality, cells and time
        assert [one["footprints"] for one in view["maps"]] == [1] * 3
        assert [image[1:] for image in view["images"]] == [[1120, 700]] * 3
    light, dark = found["desktop"], found["dark"]
    assert sum(light["paper"]) > 3 * 200 > 3 * 100 > sum(light["ink"])
    assert sum(dark["ink"]) > 3 * 200 > 3 * 100 > sum(dark["paper"])


def test_the_report_opens_without_a_fault(small_run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(small_run, tmp_path / "run")
    assert main(["report", str(copy)]) == 0
    found = open_report(copy / "report.html", tmp_path)
    check_page(found, tiles=4)
    for view in VIEWS:
        assert (tmp_path / f"{view}-whole.png").stat().st_size > 20_000
    assert (tmp_path / "print.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.shared
def test_the_report_of_amsterdam_is_small(amsterdam_run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(amsterdam_run, tmp_path / "run")
    assert main(["report", str(copy)]) == 0
    assert (copy / "report.html").stat().st_size < 3_000_000
    check_page(open_report(copy / "report.html", tmp_path), tiles=4)


def test_a_failed_tile_is_on_the_map_and_in_the_list(small_run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(small_run, tmp_path / "run")
    record = json.loads((copy / "run.json").read_text())
    name = sorted(record["tiles"])[0]
    del record["tiles"][name]
    command = f"citystitch run --only {name}"
    failure = {"stage": "columns", "name": name, "reason": "out of memory", "command": command}
    record |= {"missing": {name: failure}, "exit_code": 3}
    (copy / "run.json").write_text(json.dumps(record))
    assert main(["report", str(copy)]) == 0
    found = open_report(copy / "report.html", tmp_path)
    for view in found.values():
        assert [(one["tiles"], one["missing"]) for one in view["maps"]] == [(3, 1)] * 3
    text = (copy / "report.html").read_text()
    assert f"{name} failed: mesh: columns of cells: out of memory" in text
    assert command in text
