"""Results in a bucket, over a store in memory: what is put when, what is told, and what damage does."""

import json
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from pipeline.errors import ConfigError, InputError, OutputError
from tests.test_run import hashes
from tests.towns import Town, make_town
from tiler.cli.main import main
from tiler.config.config import load_config, make_config
from tiler.engine.stage import Scope
from tiler.objects import range_file
from tiler.objects import requests as object_requests
from tiler.objects.fetch import fetch_run
from tiler.objects.path import ObjectPath
from tiler.objects.places import StoreUnreachableError, absolute, place
from tiler.objects.range_file import RangeFile
from tiler.store import folder_lock
from tiler.store.store import Store
from tiler.workflow.run import run

obstore = pytest.importorskip("obstore")

URL = "s3://bucket/run"
ARRAYS = {"large": np.arange(3_000_000, dtype=np.int64), "wide": np.ones((40_000, 3)), "small": np.arange(4)}


class Memory:
    """obstore's store in memory, behind a rule that may make a request fail; the requests that were made."""

    def __init__(self) -> None:
        self.store: Any = obstore.store.MemoryStore()
        self.rule: Callable[[], None] = lambda: None
        self.n_asked = 0

    def client(self, root: str) -> Any:
        assert root == "s3://bucket"
        self.n_asked += 1
        self.rule()
        return self.store

    def list_keys(self) -> list[str]:
        return sorted(meta["path"] for part in obstore.list(self.store) for meta in part)


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> Memory:
    found = Memory()
    monkeypatch.setattr(object_requests, "_client", found.client)
    return found


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Waits are short, and what they tell is kept."""
    said: list[str] = []
    monkeypatch.setattr(object_requests, "FIRST_DELAY", 0.001)
    monkeypatch.setattr(object_requests, "TOLD_AFTER", 0.02)
    waits = object_requests.Waits(tell=said.append)
    monkeypatch.setattr(object_requests, "WAITS", waits)
    return said


def bucket(url: str = URL, patience: float = 600.0) -> ObjectPath:
    return cast(ObjectPath, place(url, patience))


def error(status: int) -> Exception:
    return cast(Exception, obstore.exceptions.GenericError(f"Server returned non-2xx status code: {status} x"))


def wait_until(state: Callable[[], bool]) -> None:
    end = time.monotonic() + 20
    while not state():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_place_has_the_names_of_a_path_and_survives_pickling() -> None:
    path = bucket() / "store.zarr" / "points" / "a.b.laz"
    assert (path.name, path.stem, path.suffix) == ("a.b.laz", "a.b", ".laz")
    assert str(path.parent) == "s3://bucket/run/store.zarr/points"
    assert path.relative_to(bucket()).as_posix() == "store.zarr/points/a.b.laz"
    assert pickle.loads(pickle.dumps(bucket(patience=7.0))).patience == 7.0
    assert str(place("S3://bucket//run/")) == URL
    assert absolute(URL) == URL
    with pytest.raises(ValueError, match="opened as 'wb'"):
        path.open("wb")


@pytest.mark.parametrize(
    "url",
    [
        "https://user:hidden@host/a.laz",
        "https://host/a.laz?X-Amz-Signature=hidden",
        "s3://key:hidden@bucket/run",
        "s3://bucket/run#hidden",
    ],
)
@pytest.mark.parametrize("name", ["pointcloud", "footprints", "out"])
def test_a_url_with_a_secret_is_refused_and_not_repeated(url: str, name: str) -> None:
    with pytest.raises(ConfigError, match="in the environment") as raised:
        make_config({name: url})
    assert "hidden" not in str(raised.value)


def test_other_urls_that_name_nothing_are_refused() -> None:
    for url, reason in (("gs://a/b", "unknown scheme"), ("s3:///run", "no bucket"), ("s3://a/../b", "a part")):
        with pytest.raises(ConfigError, match=reason):
            make_config({"out": url})


def test_a_configuration_file_may_name_inputs_of_servers_but_no_bucket_to_write_to(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.toml"
    path.write_text('[input]\npointcloud = ["s3://bucket/tiles", "here"]\nfootprints = "https://host/f.gpkg"\n')
    found = load_config(path)
    assert found["pointcloud"] == ["s3://bucket/tiles", str(tmp_path / "here")]
    assert found["footprints"] == "https://host/f.gpkg"
    path.write_text(f'[input]\npointcloud = ["x"]\n[run]\nout = "{URL}"\n')
    assert main(["run", str(path)]) == 2
    assert "give it on the command line" in capsys.readouterr().err


def test_a_result_has_the_files_of_one_on_a_disk_and_comes_back(memory: Memory, tmp_path: Path) -> None:
    for store in (Store(tmp_path / "store"), Store(cast(Path, bucket()))):
        store.write("stage", "name", ARRAYS, facts={"n": 1})
    folder = tmp_path / "store"
    there = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert memory.list_keys() == sorted(f"run/{name}" for name in there)
    for name in there:
        assert (bucket() / name).read_bytes() == (folder / name).read_bytes()
    store = Store(cast(Path, bucket()))
    arrays, attributes = store.read("stage", "name")
    assert attributes == {"facts": {"n": 1}}
    for name, values in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], values)
    np.testing.assert_array_equal(store.read_rows("stage", "name", "large", 5, 9), [5, 6, 7, 8])
    assert (store.stages(), store.names("stage"), store.has("stage", "name")) == (["stage"], ["name"], True)
    assert not store.has("stage", "other")
    assert store.find_damage("stage", "name") == ""
    store.remove("stage", "name")
    assert memory.list_keys() == []


def test_a_writer_that_is_killed_leaves_the_earlier_result(
    memory: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(cast(Path, bucket()))
    store.write("stage", "name", ARRAYS)
    before = store.describe("stage", "name")

    def die(self: ObjectPath, path: Path) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ObjectPath, "put_file", die)
        with pytest.raises(KeyboardInterrupt):
            store.write("stage", "name", ARRAYS | {"small": np.arange(5)})
    assert store.describe("stage", "name") == before
    store.write("stage", "name", ARRAYS | {"small": np.arange(5)})
    assert store.find_damage("stage", "name") == ""
    assert store.read("stage", "name", names=["small"])[0]["small"].tolist() == [0, 1, 2, 3, 4]


def test_a_result_that_vanished_or_changed_is_found(memory: Memory) -> None:
    store = Store(cast(Path, bucket()))
    store.write("stage", "name", ARRAYS)
    (result,) = bucket().rglob()
    whole = result.read_bytes()
    for at in (100, len(whole) // 2, len(whole) - 1):
        result.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert store.find_damage("stage", "name") == "its checksum differs"
    result.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="is damaged"):
        store.read("stage", "name")
    result.unlink()
    assert store.find_damage("stage", "name") == "is not there"
    with pytest.raises(InputError, match="is not there"):
        store.read("stage", "name")


def test_some_rows_of_a_large_result_are_read_without_the_rest(memory: Memory) -> None:
    store = Store(cast(Path, bucket()))
    values = np.random.default_rng(0).integers(0, 2**60, 3_000_000)
    store.write("stage", "name", {"large": values})
    (result,) = bucket().rglob()
    size, before = result.stat().st_size, memory.n_asked
    assert store.read_rows("stage", "name", "large", 5, 9).tolist() == values[5:9].tolist()
    assert memory.n_asked - before < 12
    assert size > 20_000_000


def test_requests_are_repeated_and_counted(memory: Memory, hasty: list[str]) -> None:
    failures = iter([error(500), error(503), error(429)])

    def rule() -> None:
        for failure in failures:
            raise failure

    memory.rule = rule
    bucket().write_bytes(b"x")
    assert memory.n_asked == 4
    assert object_requests.WAITS.retries == 3
    assert object_requests.WAITS.seconds > 0
    assert bucket().read_bytes() == b"x"
    assert memory.n_asked == 5


def test_a_pause_is_told_and_ends_with_patience(memory: Memory, hasty: list[str]) -> None:
    begin = time.monotonic()

    def rule() -> None:
        if time.monotonic() < begin + 0.1:
            raise error(503)

    memory.rule = rule
    bucket().write_bytes(b"x")
    assert "does not answer (status 503): waiting for it, at most 600 s" in hasty[0]
    assert "answers again after" in hasty[1]
    assert len(hasty) == 2

    def never() -> None:
        raise obstore.exceptions.GenericError("HTTP error: error sending request")

    memory.rule = never
    with pytest.raises(StoreUnreachableError, match=r"bound 0\.05 s \(no connection\); the same command goes on"):
        Store(cast(Path, bucket(patience=0.05))).read("stage", "name")


def test_what_another_try_does_not_mend_is_not_tried_again(memory: Memory, hasty: list[str]) -> None:
    def expect(failure: Exception, kind: type[Exception], text: str) -> None:
        def rule() -> None:
            raise failure

        memory.rule, memory.n_asked = rule, 0
        with pytest.raises(kind, match=text) as raised:
            bucket().read_bytes()
        assert memory.n_asked == 1
        assert raised.value.__cause__ is None

    expect(error(400), OSError, "refused with status 400")
    expect(FileNotFoundError("status code: 405 Method Not Allowed"), OSError, "must take HEAD and GET")
    expect(obstore.exceptions.GenericError("Content-Length Header missing"), OSError, "not tell the size")
    expect(obstore.exceptions.PermissionDeniedError("no"), PermissionError, "access denied")
    expect(error(403), PermissionError, "access denied")
    expect(obstore.exceptions.GenericError("PUT http://169.254.169.254/latest"), PermissionError, "no credentials")
    expect(FileNotFoundError("<Code>NoSuchBucket</Code>"), FileNotFoundError, "no such bucket")


def test_one_run_at_a_time_by_a_lease(memory: Memory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder_lock, "BEAT", 0.01)
    monkeypatch.setattr(folder_lock, "SILENCE", 0.3)
    out, said = cast(Path, bucket()), list[str]()
    with folder_lock.only_run(out) as check:
        assert folder_lock.is_held(out)
        with pytest.raises(ConfigError, match="another run is at work there"), folder_lock.only_run(out):
            pass
        wait_until(lambda: json.loads((bucket() / folder_lock.LOCK).read_bytes())["beats"] > 0)
        check()
    assert memory.list_keys() == []
    # An owner elsewhere that is silent is dead; one that beats is not.
    far = {"host": "far", "place": "other", "began": "1", "token": "t", "pid": 1}
    (bucket() / folder_lock.LOCK).write_bytes(json.dumps(far).encode())
    with folder_lock.only_run(out, said.append) as check:
        assert "taken over from (process 1 on far), which is dead" in said[-1]
        (bucket() / folder_lock.LOCK).write_bytes(json.dumps(far).encode())
        with pytest.raises(OutputError, match="another run has taken it over"):
            wait_until(lambda: bool(check()))
    assert memory.list_keys() == [f"run/{folder_lock.LOCK}"]  # that of the other one stays


def test_a_range_reader_reads_as_a_file_does(memory: Memory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(range_file, "LEAST", 16)
    monkeypatch.setattr(range_file, "MOST", 64)
    rng = np.random.default_rng(1)
    data = rng.integers(0, 256, 1000, np.uint8).tobytes()
    bucket().write_bytes(data)
    file = RangeFile(bucket())
    for start, size in [(0, 4), (4, 30), (900, 500), (17, 0), (999, 1), (1200, 3), (50, 400)]:
        file.seek(start)
        assert file.read(size) == data[start : start + size]
    file.seek(-10, 2)
    assert file.read() == data[-10:]
    file.seek(0)
    assert list(file) == data.splitlines(keepends=True) or b"\r" in data
    file.seek(0)
    assert b"".join(iter(file.readline, b"")) == data
    few = RangeFile(bucket())
    few.seek(500)
    few.read(8)
    assert (few.n_bytes, few.n_requests) == (16, 1)
    few.read(8)
    bucket().write_bytes(data[::-1])
    with pytest.raises(OSError, match="was changed while it was read"):
        few.read(100)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("town"))


def test_a_run_in_a_bucket_has_the_bytes_of_one_on_a_disk(
    town: Town, memory: Memory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said: list[str] = []
    record = run(make_config({**vars(town.config(tmp_path)), "out": URL}), say=said.append)
    assert record["exit_code"] == 0
    assert record["store_waits"]["driver_retries"] == 0
    assert main(["status", URL]) == 0
    assert "done" in capsys.readouterr().out
    assert main(["check", "--store", URL]) == 0
    assert "every byte is as it was written" in capsys.readouterr().out
    assert main(["fetch", URL, str(tmp_path / "out")]) == 0
    assert hashes(tmp_path / "out") == hashes(town.out)
    # What has vanished is found, and that alone is made again.
    for name in ("store.zarr/columns/", "boundary/"):
        victim = next((bucket() / name.rstrip("/")).rglob())
        victim.unlink()
    assert main(["check", "--store", URL]) == 1
    again = run(make_config({**vars(town.config(tmp_path)), "out": URL}))
    assert again["notes"]["damaged-artefact"]["count"] == 2
    assert again["tasks"]["ran"] == 2
    assert main(["check", "--store", URL]) == 0
    assert fetch_run(URL, tmp_path / "again", lambda _: None)
    assert hashes(tmp_path / "again") == hashes(town.out)
    assert not [key for key in memory.list_keys() if key.endswith(folder_lock.LOCK)]


def test_commands_that_need_files_name_the_one_that_fetches_them(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["report", URL], ["export", URL, "--format", "msh", "-o", "x"], ["render", URL, "-o", "x.png"]):
        with pytest.raises(SystemExit) as raised:
            main(words)
        assert raised.value.code == 2
        assert f"citystitch fetch {URL} DIR" in capsys.readouterr().err
    for words in (
        ["check", URL],
        ["run", "x.laz", "--out", URL, "--only", "0_0"],
        ["run", "x", "--report", "--out", URL],
    ):
        assert main(words) == 2
        assert f"citystitch fetch {URL} DIR" in capsys.readouterr().err


def test_an_object_that_would_lead_out_of_the_folder_is_not_fetched(memory: Memory, tmp_path: Path) -> None:
    bucket("s3://bucket/run/a\\b").write_bytes(b"x")
    with pytest.raises(InputError, match="can be no file of a folder"):
        fetch_run(URL, tmp_path / "out", lambda _: None)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="nothing lies below"):
        fetch_run("s3://bucket/none", tmp_path / "out", lambda _: None)


def test_an_address_that_never_answered_is_given_up_soon(
    memory: Memory, hasty: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_requests, "FIRST_PATIENCE", 0.05)
    monkeypatch.setattr(object_requests, "_answered", set())
    monkeypatch.setattr(object_requests.WAITS, "working", False)
    begin = time.monotonic()

    def rule() -> None:
        if time.monotonic() < begin + 0.3:
            raise obstore.exceptions.GenericError("HTTP error: error sending request")

    memory.rule = rule
    with pytest.raises(StoreUnreachableError, match=r"nothing has answered at s3://bucket .*check the address"):
        bucket().read_bytes()
    monkeypatch.setattr(object_requests.WAITS, "working", True)  # a worker that starts in a pause waits
    bucket().write_bytes(b"x")
    monkeypatch.setattr(object_requests.WAITS, "working", False)
    begin = time.monotonic()  # as does who was answered before
    assert bucket().read_bytes() == b"x"


def test_who_does_tasks_waits(
    memory: Memory, hasty: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tiler.engine import task as tasks

    monkeypatch.setattr(tasks, "WAITS", object_requests.WAITS)
    assert not object_requests.WAITS.working
    given = tasks.Task(
        "s", "n", Scope.TILE, (0.0, 0.0, 1.0, 1.0), None, None, "", Store(tmp_path), {}, "k", tmp_path
    )
    tasks.run_task(lambda _: {}, given)
    assert object_requests.WAITS.working
