"""docs/contributing.md is true: its format and its stage, as printed, are all that a run needs."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import tiler
from tests.repository.test_doc_code import ROOT, blocks
from tiler import formats
from tiler.cli.main import main
from tiler.export.export import export_run

FORMAT, FORMAT_TEST, STAGE, _ = blocks(ROOT / "docs" / "contributing.md", "python")


@pytest.fixture
def format_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The format of the page as a module of `tiler.formats`, from another folder."""
    folder = tmp_path / "formats"
    folder.mkdir()
    (folder / "csv.py").write_text(FORMAT)
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(folder)])
    yield folder / "csv.py"
    sys.modules.pop("tiler.formats.csv", None)


def test_a_format_is_one_file(
    format_file: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["export", "--help"])
    assert "cells and volume of each piece" in capsys.readouterr().out
    assert main(["export", str(small_run), "--format", "csv", "-o", str(tmp_path / "by_command.csv")]) == 0
    names: dict[str, Any] = {"export_run": export_run, "json": json}
    exec(FORMAT_TEST, names)
    names["test_the_table_has_all_cells"](small_run, tmp_path)
    assert (tmp_path / "by_command.csv").read_bytes() == (tmp_path / "cells.csv").read_bytes()


def test_a_stage_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("highest_example")
    monkeypatch.setitem(sys.modules, "highest_example", module)
    exec(compile(STAGE, "docs/contributing.md", "exec"), module.__dict__)
    files = tiler.write_city(tmp_path / "city", size=200, buildings=6, density=1.0, relief=0)
    city = tiler.mesh(
        str(files.clouds[0].parent),
        str(files.footprints),
        out=str(tmp_path / "out"),
        stages=[module.__dict__["HIGHEST"]],
        mesh_size=14.0,
        progress=False,
    )
    from tiler.store.store import Store

    store = Store(city.folder / "store.zarr")
    found = [store.attributes("highest", name)["facts"]["highest (m)"] for name in store.names("highest")]
    assert max(found) > 4
