"""Damaged artefacts of a run: the audit names each, the next run makes them anew, byte for byte, and says so."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipeline.data.errors import ConfigError, InputError
from tests.helpers.campaigns import keep_outcome, rounds
from tests.helpers.result_parts import parts, write_parts
from tests.helpers.towns import Town, make_town
from tests.runs.test_run import hashes
from tiler.cli.main import main
from tiler.store.checksums import seal
from tiler.store.folder_lock import only_run
from tiler.store.store import Store
from tiler.workflow.audit import Entry, audit_run, read_manifest
from tiler.workflow.run import run

SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in rounds([1], range(2, 20)))]
NOTE = "damaged-artefact"


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("town"))


def audit(out: Path) -> tuple[bool, list[str]]:
    """The verdict, and what is damaged, sorted."""
    lines: list[str] = []
    sound = audit_run(out, lines.append)
    assert all(line.startswith("DAMAGED ") for line in lines[:-1])
    assert lines[-1].startswith(f"{out}: ")
    return sound, sorted(line.removeprefix("DAMAGED ").partition(":")[0] for line in lines[:-1])


def flip(path: Path, rng: np.random.Generator) -> None:
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= rng.integers(1, 256)
    path.write_bytes(data)


def truncate(path: Path, rng: np.random.Generator) -> None:
    path.write_bytes(path.read_bytes()[: rng.integers(path.stat().st_size)])


def delete(path: Path, rng: np.random.Generator) -> None:
    path.unlink()


def change_digit(path: Path, rng: np.random.Generator) -> None:
    """Change a figure of the last number in a text, so that it stays well formed."""
    data = bytearray(path.read_bytes())
    place = [k for k, sign in enumerate(data) if sign in b"123456"][-1]
    data[place] += 1
    path.write_bytes(data)


DAMAGES = [flip, truncate, delete]
# those of which there is one file come first, before one of the others is chosen of the same result
KINDS = {
    "volume index": "mesh.pvtu",
    "boundary index": "boundary.pvtp",
    "city model": "citymodel.city.json",
    "full city model": "citymodel-full.city.json",
    "record": "run.json",
    "manifest": "store.zarr/manifest.jsonl",
    "volume": "mesh/*.vtu",
    "boundary": "boundary/*.vtp",
    "result": "store.zarr/*/*.zip",
}


def result_of(path: str) -> str:
    """The artefact that is made anew for a file: the result that it is of, or that states it."""
    parts = path.split("/")
    if parts[0] == "store.zarr" and len(parts) == 3:
        return path.removesuffix(".zip")
    if parts[0] in ("mesh", "boundary"):
        return f"store.zarr/pieces/{Path(path).stem}"
    return {f"{model}.city.json": f"store.zarr/{model}/region" for model in ("citymodel", "citymodel-full")}.get(
        path, path
    )


def choose(out: Path, pattern: str, taken: set[str], rng: np.random.Generator) -> str:
    """Choose a file of a kind, of a result of which none was chosen yet."""
    paths = sorted(path.relative_to(out).as_posix() for path in out.glob(pattern) if path.is_file())
    free = [path for path in paths if result_of(path) not in taken]
    chosen = free[rng.integers(len(free))]
    taken.add(result_of(chosen))
    return chosen


def test_a_sound_run_is_told_to_be_so(
    town: Town, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["check", str(town.out), "--store"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    n = sum(1 for _ in (town.out / "store.zarr").glob("*/*.zip"))
    assert re.search(rf": {n} results and 12 files beside the store, [\d.]+ MB: every byte is as it was", line)
    size = sum(path.stat().st_size for path in town.out.rglob("*") if path.is_file())
    others = ("run.json", "progress.json", "events.jsonl", "config.toml", "store.zarr/manifest.jsonl")
    beside = sum((town.out / name).stat().st_size for name in others)
    assert f" {(size - beside) / 1e6:.1f} MB" in line


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("damage", DAMAGES)
def test_each_kind_of_artefact_is_named_and_made_anew(
    town: Town, tmp_path: Path, damage: Callable[[Path, np.random.Generator], None], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    out = town.copy(tmp_path / "out")
    taken: set[str] = set()
    chosen = sorted(choose(out, pattern, taken, rng) for name, pattern in KINDS.items() if name != "manifest")
    for path in chosen:
        damage(out / path, rng)
    assert audit(out) == (False, chosen)
    record = run(town.config(out))
    items = record["notes"][NOTE]["items"]
    assert sorted(item["subject"] for item in items) == sorted(map(result_of, chosen))
    told = f"{len(chosen)} damaged or missing artefacts of an earlier run were made anew: {NOTE} in the notes"
    assert [message for message in record["messages"] if "damaged" in message] == [told]
    assert hashes(out) == hashes(town.out)
    assert audit(out) == (True, [])
    kinds = dict.fromkeys((name for name in KINDS if name != "manifest"), 1)
    keep_outcome("damage", what=damage.__name__, seed=seed, kinds=kinds)


def test_the_manifest_is_named_and_made_anew(town: Town, tmp_path: Path) -> None:
    """Without it damage is found all the same; what is gone without a trace is not."""
    rng = np.random.default_rng(5)
    for damage in (change_digit, *DAMAGES):
        out = town.copy(tmp_path / damage.__name__)
        damage(out / KINDS["manifest"], rng)
        result = choose(out, KINDS["result"], set(), rng)
        flip(out / result, rng)
        assert audit(out) == (False, sorted([KINDS["manifest"], result]))
    record = run(town.config(out))
    found = {item["subject"]: item["detail"] for item in record["notes"][NOTE]["items"]}
    assert found.keys() == {KINDS["manifest"], result_of(result)}
    assert found[KINDS["manifest"]] == "is not there; made anew"
    assert hashes(out) == hashes(town.out)


LOSSES = {
    "a result": (["store.zarr/columns/0_0.zip"], None),
    "a stage": (["store.zarr/terrain"], ["store.zarr/terrain/*"]),
    "all pieces": (["mesh", "boundary"], ["mesh/*", "boundary/*"]),
}


@pytest.mark.parametrize("name", list(LOSSES))
def test_what_is_gone_is_named_and_made_anew(town: Town, tmp_path: Path, name: str) -> None:
    lost, patterns = LOSSES[name]
    lost = [path.replace("0_0", next((town.out / "mesh").iterdir()).stem) for path in lost]
    expected = [path.relative_to(town.out).as_posix() for p in patterns or lost for path in town.out.glob(p)]
    out = town.copy(tmp_path / "out")
    for path in lost:
        (out / path).unlink() if path.endswith(".zip") else shutil.rmtree(out / path)
    assert audit(out) == (False, sorted(expected))
    record = run(town.config(out))
    items = record["notes"][NOTE]["items"]
    assert {item["subject"] for item in items} == set(map(result_of, expected))
    assert hashes(out) == hashes(town.out)


def test_strange_files_are_named_and_removed(town: Town, tmp_path: Path) -> None:
    out = town.copy(tmp_path / "out")
    strange = ["mesh/9_9.vtu", "mesh/.9_9.12.3.part.vtu", "boundary/9_9.vtp", "store.zarr/x.txt"]
    strange += ["store.zarr/columns/.9_9.partial", "store.zarr/columns/x.txt", "store.zarr/model/.x"]
    strange += ["store.zarr/columns/9_9.zip"]
    for path in strange:
        (out / path).write_text("x")
    (out / "store.zarr" / "columns" / "8_8").mkdir()
    (out / "store.zarr" / "strange" / "9_9").mkdir(parents=True)
    (out / "picture.png").write_text("a picture of the user's own")
    folders = ["store.zarr/columns/8_8", "store.zarr/strange"]
    assert audit(out) == (False, sorted(strange + folders))
    run(town.config(out))
    (out / "picture.png").unlink()
    assert hashes(out) == hashes(town.out)
    assert not (out / "store.zarr" / "strange").exists()


def test_an_unfinished_run_is_gone_on_with_where_it_is_sound(town: Town, tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    out = town.copy(tmp_path / "out")
    record = json.loads((out / "run.json").read_text())
    (out / "run.json").write_bytes(seal(json.dumps(record | {"status": "running", "checksum": "0" * 8}).encode()))
    shutil.rmtree(out / "store.zarr" / "columns")
    (out / "store.zarr" / "manifest.jsonl").unlink()
    taken: set[str] = set()
    chosen = sorted(choose(out, KINDS[kind], taken, rng) for kind in ("result", "result", "volume", "city model"))
    for path in chosen:
        flip(out / path, rng)
    assert audit(out) == (False, chosen)
    record = run(town.config(out))
    assert {item["subject"] for item in record["notes"][NOTE]["items"]} == set(map(result_of, chosen))
    assert hashes(out) == hashes(town.out)


def test_a_lost_index_is_written_again(town: Town, tmp_path: Path) -> None:
    out = town.copy(tmp_path / "out")
    (out / "mesh.pvtu").unlink()
    assert run(town.config(out, workers=1))["notes"][NOTE]["count"] == 1
    assert hashes(out) == hashes(town.out)


def test_a_run_whose_record_is_lost_is_known_by_its_progress_or_manifest(town: Town, tmp_path: Path) -> None:
    out = town.copy(tmp_path / "out")
    (out / "run.json").unlink()
    (out / "progress.json").unlink()
    manifest = out / "store.zarr" / "manifest.jsonl"
    manifest.rename(tmp_path / "kept")
    with pytest.raises(ConfigError, match=r"but no run\.json of a run"):
        run(town.config(out))
    (tmp_path / "kept").rename(manifest)
    record = run(town.config(out))
    assert record["tasks"]["ran"] == 0
    assert [item["subject"] for item in record["notes"][NOTE]["items"]] == ["run.json"]
    assert hashes(out) == hashes(town.out)


def test_a_result_that_was_exchanged_is_named(town: Town, tmp_path: Path) -> None:
    """One that is sound in itself, but not what the run has made; and one that does not have its own digest."""
    out = town.copy(tmp_path / "out")
    store = Store(out / "store.zarr")
    one, other = store.names("terrain")[:2]
    shutil.copyfile(store.file("terrain", other), store.file("terrain", one))
    assert audit(out) == (False, [f"store.zarr/terrain/{one}.zip"])

    out = town.copy(tmp_path / "forged")
    file = out / "store.zarr" / "terrain" / f"{one}.zip"
    _, digest = Store(out / "store.zarr").describe("terrain", one)
    found = parts(file)
    write_parts(file, found | {"zarr.json": found["zarr.json"].replace(digest.encode(), b"0" * 32)})
    (out / "run.json").write_bytes(seal(b'{"status": "failed", "checksum": "00000000"}'))
    assert audit(out) == (False, [f"store.zarr/terrain/{one}.zip"])


def test_the_manifest_lists_all_results_and_their_digests(town: Town) -> None:
    store = Store(town.out / "store.zarr")
    lines = list(read_manifest(town.out / "store.zarr" / "manifest.jsonl"))
    entries = [line for line in lines if isinstance(line, Entry)]
    assert [(entry.stage, entry.name) for entry in entries] == [
        (stage, name) for stage in store.stages() for name in store.names(stage)
    ]
    for entry in entries:
        attributes, digest = store.describe(entry.stage, entry.name)
        assert (entry.key, entry.digest, entry.files) == (
            attributes["key"],
            digest,
            attributes["facts"].get("files", {}),
        )
    assert set(lines[-1]) == {"mesh.pvtu", "boundary.pvtp"}  # type: ignore[arg-type]


def test_what_cannot_be_audited(town: Town, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds neither run\.json nor store\.zarr; give the folder of a run"):
        audit_run(tmp_path, print)
    with only_run(town.out), pytest.raises(InputError, match="a run is at work there; wait for its end"):
        audit_run(town.out, print)


def test_the_command_fails_where_something_is_damaged(
    town: Town, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = town.copy(tmp_path / "out")
    (out / "boundary.pvtp").unlink()
    assert main(["check", str(out), "--store"]) == 1
    first, last = capsys.readouterr().out.splitlines()
    assert first == "DAMAGED boundary.pvtp: is not there"
    assert last.endswith("1 damaged; give the command of the run again: it makes these anew, and no more")
