"""Clusters over a network: TLS, and hosts of their own whose links are cut."""

import json
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from distributed import LocalCluster
from distributed.security import Security

from pipeline.data.errors import CityError, ConfigError
from tests.helpers.namespaces import Host, certificates, dask_command, hosts
from tests.helpers.sparse_city import ROOT, SparseCity, children, count_results, make_city, start
from tests.runs.test_run import hashes
from tiler.config.config import idle_parameters, make_config
from tiler.executors import transport
from tiler.executors.remote_cluster import connect
from tiler.executors.transport import TlsFiles, check_answer, make_security
from tiler.workflow.failed_tiles import save_config

CUT = 30.0  # s
LOST = "the connection to the Dask scheduler is lost; all that was done is kept"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, str]:
    return certificates(tmp_path_factory.mktemp("tls") / "cluster")


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, str]:
    return certificates(tmp_path_factory.mktemp("tls") / "stranger", "stranger")


@pytest.fixture(scope="module")
def secured(files: tuple[str, str, str]) -> Iterator[str]:
    """Address of a scheduler with TLS, and a worker, in this process."""
    ca, cert, key = files
    roles = {f"tls_{role}_{what}": path for role in ("scheduler", "worker", "client")
             for what, path in (("cert", cert), ("key", key))}  # fmt: skip
    security = Security(tls_ca_file=ca, require_encryption=True, **roles)
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tls", host="127.0.0.1", security=security,
        dashboard_address="127.0.0.1:0",
    ) as cluster:  # fmt: skip
        yield str(cluster.scheduler_address)


@pytest.fixture(scope="module")
def plain() -> Iterator[str]:
    """Address of a scheduler without TLS."""
    with LocalCluster(
        n_workers=0, processes=False, protocol="tcp", host="127.0.0.1", dashboard_address="127.0.0.1:0"
    ) as cluster:
        yield str(cluster.scheduler_address)


def test_a_scheduler_with_tls_takes_its_own_certificates(secured: str, files: tuple[str, str, str]) -> None:
    with connect(secured, tls=TlsFiles(*files)) as executor:
        assert executor.workers == 1


def test_certificates_may_come_from_dasks_configuration(
    secured: str, files: tuple[str, str, str], stranger: tuple[str, str, str], tmp_path: Path
) -> None:
    from dask import config

    with config.set(dict(zip(transport.DASKS.values(), files, strict=True))):
        check_answer(secured, make_security(secured, TlsFiles()))
    # A certificate that is given goes with its own key, here in its file, not with that of the configuration.
    both = tmp_path / "both.pem"
    both.write_text(Path(files[1]).read_text() + Path(files[2]).read_text())
    with config.set(dict(zip(transport.DASKS.values(), stranger, strict=True))):
        check_answer(secured, make_security(secured, TlsFiles(files[0], str(both))))


def test_another_authority_is_refused(
    secured: str, files: tuple[str, str, str], stranger: tuple[str, str, str]
) -> None:
    security = make_security(secured, TlsFiles(stranger[0], *files[1:]))
    with pytest.raises(ConfigError, match=r"its certificate is not signed by the authority of tls_ca"):
        check_answer(secured, security)


def test_a_certificate_of_another_authority_is_refused(
    secured: str, files: tuple[str, str, str], stranger: tuple[str, str, str]
) -> None:
    security = make_security(secured, TlsFiles(files[0], *stranger[1:]))
    with pytest.raises(ConfigError, match=r"refuses the certificate of this client \(tlsv1 alert unknown ca\)"):
        check_answer(secured, security)


def test_no_certificate_is_refused(secured: str, files: tuple[str, str, str]) -> None:
    with pytest.raises(ConfigError, match=r"no cert file for TLS; give --tls-cert, or distributed\.comm\.tls"):
        make_security(secured, TlsFiles(files[0]))
    with pytest.raises(ConfigError, match=r"no ca file for TLS; give --tls-ca"):
        make_security(secured, TlsFiles())


def test_tls_and_plain_are_not_mixed_up(
    secured: str, plain: str, files: tuple[str, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is told within seconds."""
    monkeypatch.setattr(transport, "SILENT", 0.3)
    begin = time.monotonic()
    address = plain.replace("tcp", "tls")
    with pytest.raises(ConfigError, match=rf"does not speak TLS .* a scheduler without TLS is {plain}"):
        check_answer(address, make_security(address, TlsFiles(*files)))
    with pytest.raises(ConfigError, match=rf"speaks TLS; give --scheduler {secured}, and certificates"):
        check_answer(secured.replace("tls", "tcp"), None)
    check_answer(plain, None)
    assert time.monotonic() - begin < 10


def test_who_says_nothing_is_no_scheduler(files: tuple[str, str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport, "SILENT", 0.1)
    monkeypatch.setattr(transport, "CONNECT", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as server:
        place = f"127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(CityError, match=r"no Dask scheduler answers \(timed out\)"):
            check_answer(f"tcp://{place}", None)
        with pytest.raises(ConfigError, match=r"no answer by TLS within 0\.2 s"):
            check_answer(f"tls://{place}", make_security(f"tls://{place}", TlsFiles(*files)))


def test_files_that_will_not_do(files: tuple[str, str, str], tmp_path: Path) -> None:
    ca, cert, key = files
    locked = tmp_path / "locked.key"
    subprocess.run(
        ["openssl", "pkey", "-in", key, "-aes256", "-passout", "pass:word", "-out", str(locked)], check=True
    )
    for given, words in (
        (TlsFiles(str(tmp_path / "no.pem"), cert, key), r"--tls-ca .*no\.pem: cannot be read \(No such file"),
        (TlsFiles(key, cert, key), "cannot be used"),
        (TlsFiles(ca, cert), "cannot be used"),
        (TlsFiles(ca, cert, str(locked)), r"--tls-key .*locked\.key: the key has a passphrase"),
    ):
        with pytest.raises(ConfigError, match=words):
            make_security("tls://10.0.0.1:8786", given)
    with pytest.raises(ConfigError, match=r"--tls-ca: counts with --scheduler tls://HOST:PORT, not with tcp://"):
        make_security("tcp://10.0.0.1:8786", TlsFiles(ca))
    assert make_security("tcp://10.0.0.1:8786", TlsFiles()) is None
    with pytest.raises(ConfigError, match="is no address of a scheduler"):
        check_answer("tcp://10.0.0.1", None)


def test_tls_counts_with_a_scheduler_and_is_not_kept(tmp_path: Path) -> None:
    given = {"pointcloud": ["a.laz"], "tls_ca": "ca.pem", "out": str(tmp_path)}
    assert idle_parameters(make_config(given)) == ["tls_ca has no effect: it counts with scheduler"]
    assert idle_parameters(make_config(given | {"scheduler": "tls://a:1"})) == []
    save_config(make_config(given | {"scheduler": "tls://a:1"}), tmp_path)
    assert 'tls_ca = ""' in (tmp_path / "config.toml").read_text()


@contextmanager
def cluster(
    places: Sequence[Host], files: tuple[str, str, str], folder: Path
) -> Iterator["tuple[str, list[subprocess.Popen[bytes]]]"]:
    """A scheduler at the first place and a worker at each other one, as docs/cluster.md starts them."""
    folder.mkdir()
    scheduler, *others = places
    address, settings = f"tls://{scheduler.address}:8786", ["env", f"DASK_CONFIG={ROOT / 'deploy'}"]

    with ExitStack() as stack:

        def begin(host: Host, *words: str) -> "subprocess.Popen[bytes]":
            command = host.command([*settings, *dask_command(*words, "--host", host.address, tls=files)])
            process = start(command, folder / f"{host.address}.txt")
            stack.callback(end, process)
            return process

        running = [begin(scheduler, "scheduler", "--protocol", "tls", "--port", "8786")]
        running += [begin(host, "worker", address, "--nthreads", "1", "--memory-limit", "0") for host in others]
        for host in others:
            wait_for_word(folder / f"{host.address}.txt", "Registered to")
        yield address, running


def end(process: "subprocess.Popen[bytes]") -> None:
    below = children(process)
    process.kill()
    process.wait()
    for one in below:
        one.kill()


def wait_for_word(path: Path, word: str, seconds: float = 120.0) -> None:
    last = time.monotonic() + seconds
    while word not in path.read_text():
        assert time.monotonic() < last, path.read_text()
        time.sleep(0.1)


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    return make_city(tmp_path_factory.mktemp("city"), 3, buildings=12)


def command_from(host: Host, city: SparseCity, out: Path, address: str, files: tuple[str, str, str]) -> list[str]:
    """A run from a host, over TLS."""
    names = ("--tls-ca", "--tls-cert", "--tls-key")
    given = [word for pair in zip(names, files, strict=True) for word in pair]
    return host.command(city.command(out, "--scheduler", address, *given))


@pytest.mark.long
@pytest.mark.parametrize("where", ["worker", "driver"])
def test_a_link_that_is_cut_for_half_a_minute_changes_nothing(
    where: str, city: SparseCity, files: tuple[str, str, str], tmp_path: Path
) -> None:
    """Scheduler, two workers and driver are four hosts, with the settings of `deploy/dask.yaml`."""
    out, words = tmp_path / "out", tmp_path / "words.txt"
    with (
        hosts(4) as (scheduler, worker, other, driver),
        cluster((scheduler, worker, other), files, tmp_path / "cluster") as (address, _),
        ExitStack() as stack,
    ):
        process = start(command_from(driver, city, out, address, files), words)
        stack.callback(end, process)
        third, last = sum(count_results(city.out).values()) // 3, time.monotonic() + 120
        while sum(count_results(out).values()) < third:
            assert process.poll() is None, words.read_text()
            assert time.monotonic() < last
            time.sleep(0.05)
        host = worker if where == "worker" else driver
        host.cut()
        time.sleep(CUT)
        assert process.poll() is None, words.read_text()
        host.mend()
        assert process.wait(240) == 0, words.read_text()
    record = json.loads((out / "run.json").read_text())
    assert (record["status"], record["missing"], record["set_aside"]) == ("done", {}, [])
    assert hashes(out) == city.hashes


@pytest.mark.long
def test_a_driver_that_is_cut_off_for_good_ends_and_goes_on_later(
    city: SparseCity, files: tuple[str, str, str], tmp_path: Path
) -> None:
    """A scheduler whose host is gone is told after the patience of the link, here that of Dask's least."""
    out, words = tmp_path / "out", tmp_path / "words.txt"
    with (
        hosts(3) as (scheduler, worker, driver),
        cluster((scheduler, worker), files, tmp_path / "cluster") as (address, _),
        ExitStack() as stack,
    ):
        shorter = "import sys; from tiler.cli import main; from tiler.executors import remote_cluster; "
        shorter += "remote_cluster.PATIENCE = 11; sys.exit(main.main())"
        command = command_from(driver, city, out, address, files)
        at = command.index("-m")
        environment = ["env", "DASK_DISTRIBUTED__COMM__TIMEOUTS__TCP=11s"]
        command = [*command[: at - 1], *environment, command[at - 1], "-c", shorter, *command[at + 2 :]]
        process = start(command, words)
        stack.callback(end, process)
        third, last = sum(count_results(city.out).values()) // 3, time.monotonic() + 120
        while sum(count_results(out).values()) < third:
            assert process.poll() is None, words.read_text()
            assert time.monotonic() < last
            time.sleep(0.05)
        driver.cut()
        assert process.wait(60) == 1, words.read_text()
        assert words.read_text().count(LOST) == 1
        assert "Traceback" not in words.read_text()
        driver.mend()
        process = start(command_from(driver, city, out, address, files), words)
        stack.callback(end, process)
        assert process.wait(240) == 0, words.read_text()
    assert hashes(out) == city.hashes
