"""The page of a city that is served shows an edit without a reload."""

import json
import os
import shutil
from pathlib import Path

import pytest

from tests.tiler.editing.test_edit import read_input
from tests.tiler.tiles3d.test_readers import run_script
from tiler.serving.serve import serve_city


@pytest.mark.long
@pytest.mark.timeout(1500)
def test_the_page_shows_an_edit(sloped_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    city = shutil.copytree(sloped_run, tmp_path / "city")
    house, *_ = read_input(city)
    chromium = os.environ.get("CHROMIUM", "/usr/bin/chromium")
    with serve_city(city, "127.0.0.1:0") as url:
        body = json.dumps({"action": "remove", "building": house})
        words = (url, chromium, str(tmp_path), body)
        seen = run_script("browse_edits.mjs", *words, folder=tmp_path, monkeypatch=monkeypatch)
    assert "error" not in seen, seen["error"]
    assert (seen["console"], seen["reply"], seen["children"]) == ([], 201, 1)

    def of_house(when: str) -> list[str]:
        return [name for name in seen[when]["names"] if name == house or name.startswith(f"{house}-part")]

    assert of_house("before")
    assert not of_house("after")
    assert len(seen["after"]["names"]) == len(seen["before"]["names"]) - len(of_house("before"))
    assert "cells of the section" in seen["section"]["words"]
    assert (seen["section"]["pressed"], seen["section"]["left"], seen["overflow"]) == ("true", 0, 0)
    assert seen["after"]["camera"] == seen["before"]["camera"]
