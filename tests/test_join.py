"""Processes that work at one run through its folder alone: mailboxes, the lease, members that come, go and die."""

import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import CityError, ConfigError, InputError
from tests.sparse_city import SparseCity, children, make_city, start, wait_for_results, wait_until_gone
from tests.test_run import hashes
from tiler.config.config import make_config
from tiler.engine.engine import Engine
from tiler.engine.stage import Facts, Layout, Scope
from tiler.engine.task import Declared, Failure, Record, Task
from tiler.engine.task_limits import Limits, trace_file
from tiler.executors.executor import LEAST_WINDOW, WINDOW
from tiler.executors.worker_processes import Crew, Given
from tiler.joining import lease as leases
from tiler.joining import mailbox
from tiler.joining.join import ARRAY_INDEX, describe_member, join, name_member
from tiler.joining.lease import (
    Holder,
    Lease,
    LostFolderError,
    Pulse,
    newest_lease,
    read_holder,
    take_lease,
    this_holder,
    write_holder,
)
from tiler.joining.mailbox import GoneError, MailReader, MailWriter
from tiler.joining.member import Ended, Left, _Service
from tiler.joining.spool import HOLDER, INBOX, OUTBOX, SPOOL, Spool
from tiler.store.folder_lock import is_held, only_run
from tiler.store.store import Store

END = 240.0  # s that members may take
# What a member does first: imports, which take long on a busy machine, and a wait for a file; it is slow, too.
MEMBER = """
import sys, time
from pathlib import Path
from tiler.executors import worker_processes as crew
from tiler.joining import join
from tiler.cli.main import main
give = crew.Crew.give
def give_slowly(self, given):
    time.sleep(0.25)
    give(self, given)
crew.Crew.give = give_slowly
while not Path(sys.argv[1]).exists():
    time.sleep(0.02)
"""
# One that takes itself for a machine of its own, on a file system without locks.
FAR = """
import errno, fcntl, os
def refuse(*_):
    raise OSError(errno.ENOLCK, "No locks available")
fcntl.flock = refuse
from tiler.store import folder_lock
from tiler.joining import lease
folder_lock._place = lambda: f"machine {os.getpid()}"
folder_lock.BEAT, folder_lock.SILENCE, lease.BEAT, lease.SILENCE = 0.3, 4.0, 0.3, 4.0
"""
SAY = "import time; from tiler.cli.main import say; say('works as a'); time.sleep(600)"
MAIN = "sys.exit(main(sys.argv[2:]))"


def test_messages_come_once_and_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mailbox, "PART", 50)
    writer, reader = MailWriter(tmp_path / "box"), MailReader(tmp_path / "box")
    assert reader.read() == []
    sent = [bytes([k]) * 20 for k in range(10)]
    writer.write(sent[:3])
    assert reader.read() == sent[:3]
    for message in sent[3:]:
        writer.write([message])
    assert reader.read() == sent[3:]
    assert reader.read() == []
    assert len(list(tmp_path.iterdir())) == 1  # parts that were read are gone


def test_a_message_that_is_there_in_part_waits(tmp_path: Path) -> None:
    writer, reader = MailWriter(tmp_path / "box"), MailReader(tmp_path / "box")
    writer.write([b"one", b"two"])
    part = tmp_path / "box.0"
    whole = part.read_bytes()
    part.write_bytes(whole[:-1])
    assert reader.read() == [b"one"]
    part.write_bytes(whole[:-1] + b"\0")  # its length is known, its bytes are not
    time.sleep(0.05)
    assert reader.read() == []
    assert reader.waits() >= 0.05
    part.write_bytes(whole)
    assert reader.read() == [b"two"]
    assert reader.waits() == 0


def test_a_mailbox_that_was_taken_away_is_gone(tmp_path: Path) -> None:
    writer, reader = MailWriter(tmp_path / "box"), MailReader(tmp_path / "box")
    (tmp_path / "box.0").unlink()
    with pytest.raises(GoneError):
        reader.read()
    with pytest.raises(GoneError):
        writer.write([b"lost"])
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leases, "BEAT", 0.05)
    monkeypatch.setattr(leases, "SILENCE", 0.6)


def holder(name: str = "me", **others: Any) -> Holder:
    return this_holder(name, 1, {}) if not others else far(name, **others)


def far(name: str, **others: Any) -> Holder:
    """One on another machine."""
    here = this_holder(name, 1, {})
    return replace(here, owner=replace(here.owner, host="far", place="other boot", **others))


def taken(spool: Path, number: int, one: Holder | None = None) -> Lease:
    lease = take_lease(spool, number, one or holder())
    assert lease is not None
    return lease


def test_a_lease_is_given_once_and_the_next_ends_it(tmp_path: Path, fast: None) -> None:
    assert newest_lease(tmp_path) == 0
    first = taken(tmp_path, 1)
    assert take_lease(tmp_path, 1, holder()) is None
    assert newest_lease(tmp_path) == 1
    found = read_holder(first.path)
    assert found is not None
    assert found.owner.pid == os.getpid()
    first.check_now()
    second = taken(tmp_path, 2)
    with pytest.raises(LostFolderError, match="another process drives the run now"):
        first.check_now()
    second.check_now()
    second.close()
    with pytest.raises(LostFolderError):
        second.check_now()
    first.close()
    assert take_lease(tmp_path / "gone", 1, holder()) is None


def test_who_is_silent_is_dead_and_who_beats_is_not(tmp_path: Path, fast: None) -> None:
    lease = taken(tmp_path, 1, far("other"))
    pulse = Pulse(lease.path, far("other").owner)
    until = time.monotonic() + 3 * leases.SILENCE
    while time.monotonic() < until:
        assert not pulse.is_dead()
        time.sleep(0.02)
    assert pulse.heard
    lease._heart.stop()
    begin = time.monotonic()
    while not pulse.is_dead():
        assert time.monotonic() - begin < 3 * leases.SILENCE
        time.sleep(0.02)
    assert time.monotonic() - begin > 0.9 * leases.SILENCE


def test_who_could_not_look_has_heard_no_silence(
    tmp_path: Path, fast: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leases, "BLINK", 0.1)
    write_holder(tmp_path / HOLDER, far("other"))
    pulse = Pulse(tmp_path / HOLDER, far("other").owner)
    time.sleep(2 * leases.SILENCE)
    assert not pulse.is_dead()


def test_a_process_of_this_machine_is_asked_for(tmp_path: Path) -> None:
    process = subprocess.Popen(["sleep", "0"])
    process.wait()
    owner = replace(holder().owner, pid=process.pid)
    write_holder(tmp_path / HOLDER, holder())
    assert Pulse(tmp_path / HOLDER, owner).is_dead()
    assert not Pulse(tmp_path / HOLDER, holder().owner).is_dead()


def give_one(task: Task) -> Facts:
    return {"one": 1}


def crash(task: Task) -> Facts:
    os.abort()


def sleep(task: Task) -> Facts:
    time.sleep(60)
    return {}


def make_task(folder: Path, name: str) -> Task:
    store = Store(folder / "store.zarr")
    return Task(
        "ones", name, Scope.TILE, (0, 0, 1, 1), Declared("ones", {}), ("context",), "", store, {}, "key", folder
    )


class IdleCrew(Crew):
    """A crew whose workers never have a hand free: all is the members' to do."""

    def __init__(self, workers: int = 1, limits: Limits | None = None) -> None:
        self.workers, self.limits, self._hands = workers, limits or Limits(), []

    @property
    def n_free(self) -> int:
        return 0

    def collect(self, seconds: float) -> list[tuple[Given, Record | Failure]]:
        time.sleep(min(seconds, 0.01))
        return []


class HandMember:
    """A member played by the test."""

    def __init__(self, folder: Path, name: str, one: Holder) -> None:
        self.place = folder / name
        self.place.mkdir(parents=True)
        write_holder(self.place / HOLDER, one)
        self.inbox, self.outbox = MailReader(self.place / INBOX), MailWriter(self.place / OUTBOX)
        MailWriter(self.place / INBOX)
        self.contexts: list[Any] = []
        self.mail: list[tuple[Any, ...]] = []

    def has(self, n: int) -> bool:
        """Read, and tell whether so many messages but contexts have come in all."""
        messages = [pickle.loads(message) for message in self.inbox.read()]
        self.contexts += [message[1] for message in messages if message[0] == "context"]
        self.mail += [message for message in messages if message[0] != "context"]
        return len(self.mail) == n

    def send(self, *message: Any) -> None:
        self.outbox.write([pickle.dumps(message)])


def record(name: str) -> Record:
    return Record("ones", name, "key", "digest", {}, {}, {"all": 0.01})


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def spool(tmp_path: Path, said: list[str]) -> Spool:
    (tmp_path / "members").mkdir()
    return Spool(tmp_path / "members", IdleCrew(), lambda: None, said.append)


def turn_until(spool: Spool, reached: Callable[[], object]) -> None:
    end = time.monotonic() + 20
    while not reached():
        spool._turn()
        assert time.monotonic() < end


def test_members_get_tasks_and_give_outcomes(tmp_path: Path, spool: Spool, said: list[str]) -> None:
    member = HandMember(tmp_path / "members", "m", holder("m"))
    for ticket in range(3):
        spool.submit(ticket, give_one, make_task(tmp_path, str(ticket)))
    turn_until(spool, lambda: member.has(2))  # one in hand and one beside
    assert spool.workers == 2
    assert [
        (kind, ticket, function, task.name, context) for kind, ticket, function, task, context in member.mail
    ] == [
        ("task", 0, give_one, "0", 0),
        ("task", 1, give_one, "1", 0),
    ]
    assert member.contexts == [("context",)]
    assert member.mail[0][3].context is None
    member.send("done", 1, record("1"))
    assert spool.wait() == (1, record("1"))
    turn_until(spool, lambda: member.has(3))
    assert member.contexts == [("context",)]  # sent once
    assert said == [f"m (process {os.getpid()} on {holder().owner.host}) works too, with 1 workers"]


def test_what_a_dead_member_had_is_done_again_unless_it_died_of_it(
    tmp_path: Path, spool: Spool, said: list[str], fast: None
) -> None:
    member = HandMember(tmp_path / "members", "m", far("m"))
    tasks = [make_task(tmp_path, str(ticket)) for ticket in range(2)]
    for ticket, task in enumerate(tasks):
        spool.submit(ticket, give_one, task)
    turn_until(spool, lambda: member.has(2))
    trace_file(tasks[0]).parent.mkdir()
    trace_file(tasks[0]).touch()  # begun
    ticket, outcome = spool.wait()
    assert ticket == 0
    assert isinstance(outcome, Failure)
    assert outcome.kind == "killed"
    assert not member.place.exists()
    assert "is dead; 2 tasks of it are done again by others" in said[1]
    other = HandMember(tmp_path / "members", "n", holder("n"))
    turn_until(spool, lambda: other.has(1))
    assert other.mail[0][1] == 1
    assert spool.workers == 2


def test_waiting_tasks_are_taken_back_and_running_ones_waited_for(tmp_path: Path, spool: Spool) -> None:
    member = HandMember(tmp_path / "members", "m", holder("m"))
    for ticket in range(5):
        spool.submit(ticket, give_one, make_task(tmp_path, str(ticket)))
    turn_until(spool, lambda: member.has(2))
    member.send("back", [1])
    member.send("done", 0, record("0"))
    assert spool.drop_waiting() == {1, 2, 3, 4}
    assert member.has(3)
    assert member.mail[2] == ("recall",)
    assert spool.wait() == (0, record("0"))


def test_all_is_given_up_when_another_process_drives(tmp_path: Path, spool: Spool) -> None:
    member = HandMember(tmp_path / "members", "m", holder("m"))
    spool.submit(7, give_one, make_task(tmp_path, "7"))
    turn_until(spool, lambda: member.has(1))

    def lost() -> None:
        raise LostFolderError("another one")

    spool._check = lost
    spool._crew.kill = lambda: []  # type: ignore[method-assign]
    with pytest.raises(LostFolderError):
        spool.wait()
    assert spool.drop_waiting() == {7}


def test_a_member_that_is_given_up_does_not_take_the_driver_for_dead(tmp_path: Path) -> None:
    lease = taken(tmp_path, 1)
    place = tmp_path / "members.1"
    place.mkdir()
    MailWriter(place / INBOX)
    write_holder(place / HOLDER, holder())
    service = _Service(place, lease.path, holder(), IdleCrew())
    service._heart.missed = True
    assert service.work() is Left.GIVEN_UP
    service._heart.missed = False
    service.close()
    assert service.work() is Left.GIVEN_UP
    lease.close()


def test_a_member_that_is_asked_to_stop_does_not_drive(tmp_path: Path) -> None:
    """As where all elements of an array are cancelled at once, the driver among them."""
    lease = taken(tmp_path, 1)
    inbox = MailWriter(tmp_path / INBOX)
    write_holder(tmp_path / HOLDER, holder())
    service = _Service(tmp_path, lease.path, holder(), IdleCrew())
    inbox.write([pickle.dumps(("context", 1)), pickle.dumps(("task", 3, give_one, make_task(tmp_path, "3"), 0))])
    service.stop()
    assert service.work() == Ended(130, "stopped as asked; the other members go on")
    assert [pickle.loads(message) for message in MailReader(tmp_path / OUTBOX).read()] == [("back", [3])]
    lease.close()
    service._looked = -1e9
    assert service.work() == Ended(130, "stopped as asked; the other members go on")
    service._stop, service._looked = False, -1e9
    assert service.work() is Left.DRIVER_GONE
    service.close()
    assert not tmp_path.exists()


@pytest.mark.long
def test_workers_that_die_are_told_and_replaced(tmp_path: Path) -> None:
    crew = Crew(1, Limits(seconds=2.0))
    try:
        outcomes = {}
        for name, function in (("a", crash), ("b", sleep), ("c", give_one)):
            crew.give(Given(0, function, make_task(tmp_path, name)))
            with pytest.raises(ValueError, match="all 1 workers have a task"):
                crew.give(Given(1, function, make_task(tmp_path, name)))
            found: list[Any] = []
            while not found:
                found = crew.collect(1.0)
            outcomes[name] = found[0][1]
        assert (outcomes["a"].kind, outcomes["b"].kind) == ("crash", "time")
        assert "not done after 2 s" in str(outcomes["b"].error)
        assert outcomes["c"].facts == {"one": 1}
        given = Given(5, sleep, make_task(tmp_path, "d"))
        crew.give(given)
        assert crew.kill() == [given]
        assert crew.n_free == 1
    finally:
        crew.close()


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ({"overwrite": True}, "overwrite: members of a run work with what is in its folder"),
        ({"scheduler": "tcp://a:1"}, "scheduler: members of a run"),
        ({"workers": 2, "dask": True}, "dask: members of a run"),
        ({"out": "s3://bucket/run"}, "s3://bucket/run: members of a run share a folder"),
        ({}, "no point cloud"),
    ],
)
def test_what_members_cannot_do_is_refused(tmp_path: Path, others: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        join(make_config({"out": str(tmp_path / "out")} | others))
    assert not (tmp_path / "out").exists()


def test_members_are_named_after_their_element_of_an_array(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ARRAY_INDEX:
        monkeypatch.delenv(variable, raising=False)
    assert name_member("") == f"{socket.gethostname()}-{os.getpid()}"
    monkeypatch.setenv("SGE_TASK_ID", "undefined")  # no array
    assert name_member("").endswith(f"-{os.getpid()}")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "7")
    assert name_member("") == "element-7"
    assert name_member("mine") == "mine"


@pytest.mark.parametrize(("name", "idle", "words"), [("../a", 1.0, "--member '../a'"), ("a", 0.0, "above 0 s")])
def test_wrong_options_are_refused(tmp_path: Path, name: str, idle: float, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        join(make_config({"pointcloud": ["a.laz"]}), member=name, max_idle=idle)


def test_a_folder_that_another_run_holds_is_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tiler.joining.join.Crew", IdleCrew)
    config = make_config({"pointcloud": ["a.laz"], "out": str(tmp_path)})
    begin = time.monotonic()
    with only_run(tmp_path), pytest.raises(CityError, match=r"has been at work there for 0\.7 s") as caught:
        join(config, max_idle=0.7)
    assert caught.value.exit_code == 1
    assert time.monotonic() - begin > 0.7
    assert list(tmp_path.iterdir()) == []
    # Once it is free the run begins, and all of its members would end by its error.
    held, looks = only_run(tmp_path), list[Path]()

    def look(out: Path) -> bool:
        looks.append(out)
        if len(looks) == 2:
            held.__exit__(None, None, None)
        return is_held(out)

    monkeypatch.setattr("tiler.joining.join.is_held", look)
    held.__enter__()
    with pytest.raises(InputError, match=r"a\.laz"):
        join(config, max_idle=60)
    assert looks == [tmp_path] * 2
    assert not (tmp_path / SPOOL).exists()


def test_more_tasks_are_in_flight_when_workers_come(tmp_path: Path, spool: Spool) -> None:
    engine = Engine(tmp_path / "store.zarr", Layout({}, {}, {}, (0, 0, 1, 1)), parameters=None, executor=spool)
    assert engine._window == LEAST_WINDOW
    spool.workers = 10
    assert engine._window == 10 * WINDOW


def test_words_are_in_a_log_file_at_once(tmp_path: Path) -> None:
    process = start([sys.executable, "-c", SAY], tmp_path / "log")
    try:
        end = time.monotonic() + 60
        while (tmp_path / "log").read_text() != "works as a\n":
            assert time.monotonic() < end
            time.sleep(0.02)
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> SparseCity:
    return make_city(tmp_path_factory.mktemp("city"), 3, buildings=30)


class Members:
    """Members of a run as processes; they begin when they are told to."""

    def __init__(self, city: SparseCity, folder: Path, *, code: str = "") -> None:
        self.city, self.folder, self.out = city, folder, folder / "out"
        self.begin = [sys.executable, "-c", MEMBER + code + MAIN]
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.n = sum(city.stages().values())

    def prepare(self, name: str, *others: str) -> "subprocess.Popen[bytes]":
        words = self.city.command(self.out, "--member", name, *others)
        command = [*self.begin, str(self.folder / f"{name}.go"), "join", *words[words.index("run") + 1 :]]
        self.processes[name] = start(command, self.folder / f"{name}.txt")
        return self.processes[name]

    def go(self, *names: str) -> None:
        for name in names:
            (self.folder / f"{name}.go").touch()

    def words(self, name: str) -> str:
        return (self.folder / f"{name}.txt").read_text(errors="replace")

    def wait_for_words(self, name: str, words: str, seconds: float = 120.0) -> None:
        end = time.monotonic() + seconds
        while words not in self.words(name):
            assert time.monotonic() < end, self.tell()
            assert self.processes[name].poll() is None, self.tell()
            time.sleep(0.02)

    def tell(self) -> str:
        return "\n".join(f"{name}: {self.words(name)}" for name in self.processes)

    def driver(self) -> str:
        """Name of who drives."""
        number = newest_lease(self.out / SPOOL)
        one = read_holder(self.out / SPOOL / f"driver.{number}") if number else None
        return one.member if one is not None else ""

    def wait_for_driver(self, *but: str) -> str:
        end = time.monotonic() + 120
        while (name := self.driver()) in ("", *but):
            assert time.monotonic() < end, self.tell()
            time.sleep(0.02)
        return name

    def wait_for(self, share: float) -> None:
        """Wait until so much of the run is done."""
        process = self.processes[self.wait_for_driver()]
        wait_for_results(process, self.out, int(share * self.n), END)
        assert process.poll() is None, self.tell()

    def end(self, *names: str) -> None:
        """All members end well, with the bytes of the reference and nothing else."""
        codes = {name: self.processes[name].wait(END) for name in names}
        assert set(codes.values()) == {0}, f"{codes} {self.tell()}"
        assert "Traceback" not in self.tell()
        record = json.loads((self.out / "run.json").read_text())
        assert (record["status"], record["exit_code"], record["missing"]) == ("done", 0, {})
        assert hashes(self.out) == self.city.hashes
        assert not (self.out / SPOOL).exists()

    def kill(self, name: str) -> None:
        process = self.processes[name]
        below = children(process)
        process.kill()
        process.wait()
        living = wait_until_gone(below, 30.0)
        assert not living, f"{living} outlive their member"


@pytest.fixture
def members(city: SparseCity, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Members]:
    found = Members(city, tmp_path, code=getattr(request, "param", ""))
    yield found
    for process in found.processes.values():
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_members_of_other_folders_have_the_same_parameters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A path is the file that it means; a URL is itself wherever a member was started."""
    url = "https://host/a.laz"
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path)
    first = describe_member(make_config({"pointcloud": [url, "b.laz"], "out": "s3://bucket/run"}))
    monkeypatch.chdir(tmp_path / "a")
    second = describe_member(make_config({"pointcloud": [url, "../b.laz"], "out": "s3://bucket/run"}))
    assert first == second
    assert (first["pointcloud"], first["footprints"]) == ([url, str(tmp_path / "b.laz")], "")
    assert first != describe_member(make_config({"pointcloud": [url, "b.laz"], "out": "s3://bucket/run"}))


@pytest.mark.long
def test_three_members_make_the_bytes_of_one_process(members: Members) -> None:
    for name in "abc":
        members.prepare(name)
    differing = members.prepare("differing", "--mesh-size", "21")
    members.prepare("late")
    members.go("a", "b", "c")
    driver = members.wait_for_driver()
    members.go("differing")
    assert differing.wait(END) == 2
    assert "mesh_size = 21.0 here, 20.0 in the run at work there" in members.words("differing")
    members.end("a", "b", "c")
    assert members.words(driver).count(" works too, with 1 workers") == 2
    members.go("late")  # after the end it finds all done
    members.end("late")
    assert f"0 of {members.n} tasks ran, {members.n} results were there\n" in members.words("late")


@pytest.mark.long
def test_members_and_drivers_die_and_others_come(members: Members) -> None:
    for name in "abcd":
        members.prepare(name)
    members.go("a", "b", "c")
    driver = members.wait_for_driver()
    member, third = sorted(set("abc") - {driver})
    members.wait_for_words(driver, f"{member} (process")
    members.wait_for(0.2)
    members.kill(member)
    members.go("d")
    members.wait_for_words("d", f"works as d for {driver}")
    members.wait_for(0.4)
    members.kill(driver)
    second = members.wait_for_driver(driver)
    members.wait_for(0.5)
    members.processes[second].terminate()  # asked to stop: another one takes its place at once
    assert members.processes[second].wait(END) == 130
    (last,) = {third, "d"} - {second}
    members.end(last)
    assert f"{member} (process {members.processes[member].pid} on" in members.words(driver)
    assert "is dead" in members.words(driver)


@pytest.mark.long
@pytest.mark.parametrize("members", [FAR], indirect=True)
def test_who_slept_on_another_machine_is_replaced_and_joins_again(members: Members) -> None:
    for name in "ab":
        members.prepare(name)
    members.go("a", "b")
    driver = members.wait_for_driver()
    (other,) = set("ab") - {driver}
    members.wait_for_words(driver, f"{other} (process")
    members.wait_for(0.1)
    os.killpg(members.processes[other].pid, signal.SIGSTOP)
    members.wait_for_words(driver, "is dead")
    os.killpg(members.processes[other].pid, signal.SIGCONT)
    members.wait_for_words(other, "the driver has given this member up")
    members.wait_for(0.5)
    assert members.driver() == driver
    os.killpg(members.processes[driver].pid, signal.SIGSTOP)
    assert members.wait_for_driver(driver) == other
    members.wait_for(0.7)
    os.killpg(members.processes[driver].pid, signal.SIGCONT)
    members.wait_for_words(driver, "another process drives the run now")
    members.end("a", "b")  # the old driver has written nothing more
    assert f"works as {driver} for {other}" in members.words(driver)
