"""`run --keep`: what stays of a run that is done, what that is enough for, and what the next run makes of it."""

import shutil
from pathlib import Path

import pytest

from pipeline.data.errors import ConfigError
from tiler.check.check import check_run
from tiler.config.config import make_config
from tiler.config.config_file import with_file
from tiler.export.export import export_run
from tiler.report.write import write_report
from tiler.store.out_folder import CONFIG, INDEXES, MANIFEST_PATH, PIECES, STORE
from tiler.store.results import StoredTerrain
from tiler.store.store import MANIFEST
from tiler.workflow.audit import audit_run
from tiler.workflow.run import run


def files_of(out: Path) -> dict[str, bytes]:
    """Bytes of the pieces, of their indexes, and of the results in the store."""
    folders = (*PIECES, STORE)
    paths = [*(out / name for name in INDEXES), *(path for name in folders for path in (out / name).rglob("*"))]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in paths if path.is_file()}


def test_a_run_keeps_what_is_asked_for(small_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(small_run, out)
    whole = files_of(out)
    given = {"pointcloud": [str(out / CONFIG)], "out": str(out)}

    def again(keep: str) -> tuple[int, dict[str, bytes]]:
        record = run(make_config(with_file(given | {"keep": keep})))
        assert not record["notes"].get("damaged-artefact")
        said: list[str] = []
        assert audit_run(out, said.append), said
        return record["tasks"]["ran"], files_of(out)

    ran, kept = again("store")
    assert ran == 0
    assert {name.split("/")[0] for name in kept} == {STORE}
    manifest = kept.pop(MANIFEST_PATH)
    assert manifest != whole[MANIFEST_PATH]
    assert kept.items() <= whole.items()
    for command in (
        lambda: check_run(out, StoredTerrain),
        lambda: export_run(out, tmp_path / "x.vtu", name="vtu"),
        lambda: write_report(out),
    ):
        with pytest.raises(ConfigError, match="has no pieces, its run kept the store alone"):
            command()
    ran, kept = again("both")
    assert 0 < ran <= 5  # a piece a tile, and what sums these up
    assert kept == whole
    ran, kept = again("pieces")
    assert ran == 0
    assert {name.split("/")[1] for name in kept if name.startswith(STORE)} == {MANIFEST, "pieces", "terrain"}
    assert check_run(out, StoredTerrain).ok
    with pytest.raises(ConfigError, match="has no store, its run kept the pieces alone"):
        write_report(out)
    ran, kept = again("both")
    assert ran > 20
    assert kept == whole
