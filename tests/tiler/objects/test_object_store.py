"""Results in a bucket, over a store in memory: what is put when, what is told, and what damage does."""

import json
import pickle
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from pipeline.data.errors import ConfigError, InputError, OutputError
from tests.helpers.flaky_proxy import FlakyProxy, flaky_proxy
from tests.helpers.object_servers import BUCKET, S3Server, environment, s3_server
from tests.helpers.told import Listener
from tests.helpers.towns import Town, make_town
from tests.runs.test_run import hashes
from tiler.cli.main import main
from tiler.config.config import make_config
from tiler.config.config_file import load_config
from tiler.engine.stage import Scope
from tiler.engine.task import Task, run_task
from tiler.objects import path as object_path
from tiler.objects import requests as object_requests
from tiler.objects.path import ObjectPath, RangeFile
from tiler.objects.places import Place, absolute, find_within, identify, place, remove
from tiler.objects.requests import ChangedError, StoreUnreachableError, trust_addresses
from tiler.store import folder_lock
from tiler.store.store import Store
from tiler.workflow.fetch import fetch_run
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

    def make_store(self, root: str, patience: float) -> Any:
        assert root == "s3://bucket"
        return self

    def get(self, *words: Any, **options: Any) -> Any:
        self.n_asked += 1
        self.rule()
        return self.store.get(*words, **options)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.store, name)

    def list_keys(self) -> list[str]:
        return sorted(meta["path"] for part in obstore.list(self.store) for meta in part)


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> Memory:
    found = Memory()
    monkeypatch.setattr(object_requests, "make_store", found.make_store)
    return found


@pytest.fixture(scope="module")
def server() -> Iterator[S3Server]:
    pytest.importorskip("moto")
    with s3_server() as found:
        yield found


@pytest.fixture
def proxy(server: S3Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[FlakyProxy]:
    """A real server, behind a proxy that fails on demand; nothing has answered to this process so far."""
    monkeypatch.setattr(object_requests, "_known", set())
    monkeypatch.setitem(object_requests.BACKOFF, "init_backoff", timedelta(milliseconds=5))
    with flaky_proxy(server.port) as found:
        for name, value in environment(found.url).items():
            monkeypatch.setenv(name, value)
        yield found


def fail_first(proxy: FlakyProxy, fault: str, n: int = 2) -> None:
    """Let the next requests fail."""
    proxy.seen.clear()
    proxy.fault = lambda number, _method, _path: fault if number < n else ""


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
    (result,) = bucket().rglob("*")
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
    (result,) = bucket().rglob("*")
    size, before = result.stat().st_size, memory.n_asked
    assert store.read_rows("stage", "name", "large", 5, 9).tolist() == values[5:9].tolist()
    assert memory.n_asked - before < 12
    assert size > 20_000_000


@pytest.mark.parametrize("fault", ["500", "503", "429", "cut", "lost"])
def test_what_another_try_may_mend_is_tried_again(proxy: FlakyProxy, tmp_path: Path, fault: str) -> None:
    """Of every kind of request that is made of a store."""
    path, data = bucket(f"s3://{BUCKET}/{fault}/a"), bytes(range(256)) * 30_000
    (tmp_path / "large").write_bytes(data)

    def check(request: Callable[[], Any], expected: Any) -> None:
        fail_first(proxy, fault)
        assert request() == expected
        assert proxy.failed[fault] == 2
        proxy.failed.clear()

    check(lambda: path.put_file(tmp_path / "large"), None)
    check(lambda: (path / "b").write_bytes(b"x"), None)
    check(lambda: path.read_bytes() == data, True)
    check(lambda: path.read_range(3, 9), data[3:9])
    check(path.parent.list_sizes, {"a": len(data), "a/b": 1})
    check(lambda: [one.name for one in path.parent.iterdir()], ["a", "a"])
    check(path.is_file, True)
    check(path.unlink, None)
    check(lambda: path.delete([path / "b", path / "c"]), None)
    fail_first(proxy, fault)
    if fault == "lost":  # the second try finds what the first has put
        with pytest.raises(ChangedError):
            path.put_if(b"x", None)
    else:
        assert path.put_if(b"x", None) == path.stat().e_tag
    assert path.read_bytes() == b"x"


def test_patience_is_shorter_than_s3_takes_a_signed_request() -> None:
    assert make_config({"store_patience": 840.0}).store_patience == 840.0
    with pytest.raises(ConfigError, match="store_patience"):
        make_config({"store_patience": 900.0})


def test_patience_ends(proxy: FlakyProxy) -> None:
    url = f"s3://{BUCKET}/run"
    fail_first(proxy, "503", 10**6)
    text = r"no sound answer for \d s, bound 0\.05 s \(status 503\); the same command goes on where the run ended"
    with pytest.raises(StoreUnreachableError, match=text):
        Store(cast(Path, bucket(url, patience=0.05))).read("stage", "name")
    fail_first(proxy, "cut", 10**6)
    with pytest.raises(StoreUnreachableError, match=r"\(no connection\)"):
        bucket(url, patience=0.05).write_bytes(b"x")


def test_an_address_that_never_answered_is_given_up_soon(
    proxy: FlakyProxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_requests, "FIRST_PATIENCE", 0.2)
    path = bucket(f"s3://{BUCKET}/run")

    def go_silent(fault: str) -> None:
        end = time.monotonic() + 1.0
        proxy.fault = lambda _number, _method, _path: fault if time.monotonic() < end else ""

    go_silent("cut")
    with pytest.raises(StoreUnreachableError, match=rf"nothing has answered at s3://{BUCKET} .*check the address"):
        path.read_bytes()
    trust_addresses(True)  # a worker that starts in a pause waits
    go_silent("cut")
    path.write_bytes(b"x")
    trust_addresses(False)
    go_silent("cut")  # as does who was answered before
    assert path.read_bytes() == b"x"
    monkeypatch.setattr(object_requests, "_known", set())
    go_silent("503")  # and who is answered at all
    assert path.read_bytes() == b"x"


def test_who_does_tasks_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_requests, "_known", set())
    given = Task("s", "n", Scope.TILE, (0.0, 0.0, 1.0, 1.0), None, None, "", Store(tmp_path), {}, "k", tmp_path)
    run_task(lambda _: {}, given)
    assert object_requests._known == {object_requests.EVERY}


def test_a_lease_is_taken_though_the_answer_was_lost(proxy: FlakyProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder_lock, "BEAT", 0.01)
    out = bucket(f"s3://{BUCKET}/lease")

    def lose_first(kind: str) -> None:
        seen: list[int] = []

        def fault(number: int, method: str, path: str) -> str:
            if method == kind and path.endswith(folder_lock.LOCK):
                seen.append(number)
            return "lost" if seen == [number] else ""

        proxy.fault = fault

    lose_first("PUT")
    with folder_lock.only_run(cast(Path, out)) as check:
        wait_until(lambda: json.loads((out / folder_lock.LOCK).read_bytes())["beats"] > 0)
        lose_first("PUT")  # of a beat
        beats = json.loads((out / folder_lock.LOCK).read_bytes())["beats"]
        wait_until(lambda: json.loads((out / folder_lock.LOCK).read_bytes())["beats"] > beats + 2)
        check()
    assert proxy.failed["lost"] == 2
    assert not out.exists()


def test_disk_and_bucket_do_the_same(memory: Memory, tmp_path: Path) -> None:
    """What runs and readers do with a place."""

    def check(out: Place, write: Callable[[str], object]) -> list[object]:
        for name in ("mesh/1.vtu", "mesh/0.vtu", "run.json", "store/a/b/c"):
            write(name)
        found: list[object] = [out.name, (out / "mesh" / "1.vtu").stem, (out / "x.laz").suffix]
        found += [out.parent.exists(), out.is_dir(), out.is_file(), (out / "run.json").is_file(), out.is_symlink()]
        found += [sorted(path.name for path in out.iterdir()), sorted(path.name for path in out.glob("*.json"))]
        found += sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
        found += [(out / "run.json").read_bytes(), (out / "mesh" / "2.vtu").exists(), (out / "none").is_dir()]
        (out / "run.json").unlink()
        remove(out / "store")
        remove(out / "mesh" / "0.vtu")
        return [*found, *sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())]

    def write(name: str) -> None:
        path = tmp_path / "run" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())

    there = bucket()
    objects = check(there, lambda name: (there / name).write_bytes(name.encode()))
    assert objects == check(tmp_path / "run", write)
    assert identify(there / "mesh/1.vtu").split()[0] == identify(tmp_path / "run/mesh/1.vtu").split()[0] == "10"


def test_a_place_within_others_is_found(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "a")
    url = place("s3://bucket/a/b")
    assert find_within([tmp_path / "ab", tmp_path / "link" / "c"], [tmp_path / "a"]) == tmp_path / "link" / "c"
    assert find_within([tmp_path / "a", url], [place("s3://bucket/a")]) == url
    assert find_within([url, tmp_path], [tmp_path / "a", place("s3://bucket/a/bc")]) is None


def test_what_another_try_does_not_mend_is_not_tried_again(memory: Memory) -> None:
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
        assert "taken over from process 1 on far, which is dead" in said[-1]
        (bucket() / folder_lock.LOCK).write_bytes(json.dumps(far).encode())
        with pytest.raises(OutputError, match="another run has taken it over"):
            wait_until(lambda: bool(check()))
    assert memory.list_keys() == [f"run/{folder_lock.LOCK}"]  # that of the other one stays


def test_a_range_reader_reads_as_a_file_does(memory: Memory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_path, "LEAST", 16)
    monkeypatch.setattr(object_path, "MOST", 64)
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
    record = run(make_config({**vars(town.config(tmp_path)), "out": URL}), watchers=[Listener(said.append)])
    assert record["exit_code"] == 0
    assert main(["status", URL]) == 0
    assert "done" in capsys.readouterr().out
    assert main(["check", "--store", URL]) == 0
    assert "every byte is as it was written" in capsys.readouterr().out
    assert main(["fetch", URL, str(tmp_path / "out")]) == 0
    assert hashes(tmp_path / "out") == hashes(town.out)
    # What has vanished is found, and that alone is made again.
    for name in ("store.zarr/columns/", "boundary/"):
        victim = next((bucket() / name.rstrip("/")).rglob("*"))
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
