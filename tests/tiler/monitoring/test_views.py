"""What a run shows: a live view on a terminal, lines elsewhere, and the options that change it."""

import io
import logging
import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from rich.console import Console

from pipeline.data.errors import GeometryError, InputError
from tests.helpers.programs import run_program
from tests.helpers.towns import Town, make_town
from tests.tiler.monitoring.test_events import kinds, record_of, start_of
from tiler.cli.main import main
from tiler.engine.stage import Scope
from tiler.engine.watcher import RunStart
from tiler.monitoring.events import read_events
from tiler.monitoring.items import State
from tiler.monitoring.live_view import LiveView, draw
from tiler.monitoring.run_log import LISTED_FAILURES, LOGGER, LogView, RunLog
from tiler.monitoring.run_state import RunState
from tiler.monitoring.stage_state import estimate_work
from tiler.monitoring.terminal import make_view
from tiler.monitoring.watchers import Watchers
from tiler.workflow.run import run

ROOT = Path(__file__).resolve().parents[3]
HIDE, SHOW = "\x1b[?25l", "\x1b[?25h"
COLOUR = re.compile(r"\x1b\[[0-9;]*[1-9][0-9;]*m")


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    return make_town(tmp_path_factory.mktemp("town"))


def start_with(out: Path, **totals: int) -> RunStart:
    expected = {stage: (Scope.TILE, total) for stage, total in totals.items()}
    return RunStart(out, "", (0.0, 0.0, 1.0, 1.0), "EPSG:28992", 1.0, 2, {}, {}, expected)


def do(watcher: Any, stage: str, names: range, total: int, seconds: float = 1.0, **others: Any) -> None:
    for k in names:
        watcher.submitted(stage, f"{k}_0")
        watcher.done(stage, k + 1, total, record_of(stage, f"{k}_0", seconds={"all": seconds}, **others))


@pytest.fixture
def at_100(monkeypatch: pytest.MonkeyPatch) -> float:
    """The time at which all events happen."""
    monkeypatch.setattr("tiler.monitoring.watchers.time.time", lambda: 100.0)
    return 100.0


@pytest.mark.usefixtures("at_100")
def test_time_left_is_that_of_what_is_measured_and_typical_of_the_rest(tmp_path: Path) -> None:
    told = Watchers()
    told.begin(start_with(tmp_path, columns=10, pieces=10))
    state = told.state
    assert state.time_left(100.0) is None
    do(told, "columns", range(5), 10, seconds=2.0)
    assert state.time_left(102.0) is None  # too early to tell
    left = estimate_work(state.stages)
    assert left == pytest.approx({"columns": 10.0, "pieces": 20.0 * 0.10 / 0.13})
    assert state.time_left(110.0) == pytest.approx(10.0 + 20.0 * 0.10 / 0.13)  # 10 s of work took 10 s
    assert state.share_done(110.0) == pytest.approx(10.0 / (20.0 + 20.0 * 0.10 / 0.13))
    assert state.stages["columns"].rate(110.0) == pytest.approx(0.5)
    do(told, "columns", range(5, 10), 10, seconds=2.0)
    do(told, "pieces", range(5), 10, seconds=8.0)
    assert estimate_work(state.stages) == pytest.approx({"pieces": 40.0})
    assert state.time_left(130.0) == pytest.approx(40.0 * 30.0 / 60.0)  # two workers did 60 s of work in 30 s
    do(told, "pieces", range(5, 10), 10)
    assert (state.time_left(130.0), state.share_done(130.0)) == (0.0, 1.0)


def test_the_state_counts(tmp_path: Path) -> None:
    told = Watchers()
    told.begin(start_with(tmp_path, columns=3, pieces=3))
    do(told, "columns", range(1), 3, notes={"odd": 2}, peak_memory=7)
    do(told, "columns", range(1, 2), 3, reused=True, peak_memory=5)
    told.submitted("columns", "2_0")
    run, state = told.state, told.state.stages["columns"]
    assert (len(run.at_work), state.in_hand, state.left) == (1, 1, 1)
    told.failed("columns", "2_0", "wet")
    told.failed("pieces", "2_0", "not run", ("columns", "2_0"))
    assert (len(run.at_work), run.n_own, run.n_failures, run.memory, run.notes.total()) == (0, 1, 2, 7, 2)
    assert (state.done, state.reused, state.failed, state.left) == (2, 1, 1, 0)
    told.planned("columns", Scope.TILE, 2)  # without the tile that failed
    assert (state.total, state.done, state.failed, state.counts[State.FAILED]) == (2, 0, 0, 1)
    told.done("pieces", 1, 3, record_of("pieces", "2_0"))  # which now needs nothing that failed
    assert (run.stages["pieces"].done, run.stages["pieces"].failed) == (1, 0)


def busy_state(tmp_path: Path, n: int) -> RunState:
    """The state of many stages at work, with long names and large numbers."""
    told = Watchers()
    told.begin(start_with(tmp_path, **{f"stage_with_a_long_name_{k}": 3_000_000 for k in range(n)}))
    for k in range(n):
        stage = f"stage_with_a_long_name_{k}"
        told.submitted(stage, "a")
        do(told, stage, range(1_234_566, 1_234_567), 3_000_000, notes={"building-with-a-fault": 1000})
        told.failed(stage, "b", "wet")
        told.submitted(stage, "c")
    return told.state


@pytest.mark.parametrize(("width", "height"), [(80, 24), (200, 50), (60, 8), (20, 3)])
@pytest.mark.parametrize("n", [1, 40])
def test_no_row_is_too_wide_and_the_view_is_not_too_high(
    tmp_path: Path, at_100: float, width: int, height: int, n: int
) -> None:
    state = busy_state(tmp_path, n)
    view = draw(state, width, height, now=at_100)
    rows = view.plain.split("\n")
    assert max(map(len, rows)) < width
    assert len(rows) < height
    if width >= 80:
        assert rows[0].startswith("  stage_with_a_lon ")
        assert " 1,234,567/3,000,000 " in rows[0]
        assert "steps at work" in rows[-3] if n == 40 else True
        assert rows[-2].endswith(f"0 of {n} steps")
        assert rows[-1].startswith("  0:00:00, 2 workers, ")
        assert f"{n:,} failed" in rows[-1]
    assert ("notes: building with a fault" in rows[-1]) is (width == 200)
    assert draw(state, width, height, now=at_100, plain=True).plain.isascii()


def test_a_view_by_hand(tmp_path: Path, at_100: float) -> None:
    told = Watchers()
    told.begin(start_with(tmp_path, columns=10, pieces=10, report=1))
    assert draw(told.state, 80, 24, now=at_100).plain.split("\n")[0].rstrip() == (
        f"  {'all':<16} {'─' * 22}   0%        starting  0 of 2 steps"
    )
    do(told, "columns", range(5), 10, seconds=2.0, notes={"odd": 1}, peak_memory=300 * 2**20)
    told.submitted("columns", "5_0")
    assert draw(told.state, 80, 24, now=at_100 + 10.0).plain.split("\n") == [
        f"  {'mesh':<16} {'━' * 11}{'─' * 11}          5/10  30.0/min   2.00 s each",
        f"  {'all':<16} {'━' * 6}{'─' * 16}  28%     ~ 26 s left  0 of 2 steps",
        "  0:00:10, 2 workers, 1 task in hand, peak 300 MiB, 5 warnings",
    ]


def logged(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


def test_the_log_tells_stages_failures_and_what_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "citystitch")
    lines = Watchers([RunLog()])
    lines.begin(start_with(tmp_path, columns=3, pieces=40))
    do(lines, "columns", range(3), 3, seconds=1.5)
    lines.say("so it is")
    for k in range(LISTED_FAILURES + 5):
        lines.failed("columns", f"{k}", "wet")
        lines.failed("pieces", f"{k}", "not run", ("columns", f"{k}"))
    texts = logged(caplog)
    assert texts[:2] == ["  mesh              3 tasks      4.50 s", "so it is"]
    assert texts[2] == "failed: mesh: columns of cells 0: wet"
    assert len(texts) == 2 + LISTED_FAILURES + 1
    assert "run.json will list all" in texts[-1]
    errors = [record.levelno == logging.ERROR for record in caplog.records]
    assert errors == [False, False] + [True] * (LISTED_FAILURES + 1)


def test_each_item_is_told_where_it_is_asked_for(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "citystitch")
    lines = Watchers([RunLog()])
    lines.begin(start_with(tmp_path, columns=2, pieces=2))
    do(lines, "columns", range(1), 2, seconds=1.5, notes={"odd": 2})
    do(lines, "columns", range(1, 2), 2, seconds=0.0, reused=True)
    lines.failed("pieces", "0_0", "not run: columns", ("columns", "0_0"))
    assert logged(caplog) == [
        "    mesh: columns of cells 0_0  1.50 s, 2 notes: odd",
        "    mesh: columns of cells 1_0  was there",
        "  mesh              2 tasks      1.50 s",
        "failed: output: files of the mesh 0_0: not run: columns",
    ]


def test_a_long_stage_says_now_and_then_how_far_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    for every, expected in ((60.0, ""), (0.0, "  mesh: 1 of 10 tasks\n  mesh: 2 of 10 tasks\n")):
        view = make_view(console=Console(file=io.StringIO()))
        do(Watchers([RunLog(every=every)]), "columns", range(2), 10)
        view.end("done")
        assert capsys.readouterr().out == expected


def test_who_configures_logging_hears_of_a_run_without_a_view(
    town: Town, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "citystitch")
    run(town.config(town.copy(tmp_path / "out")))
    assert "  mesh              4 tasks      0.00 s" in logged(caplog)
    assert re.fullmatch(r"0 of \d+ tasks ran, \d+ results were there", logged(caplog)[-1])
    assert {record.name for record in caplog.records} == {"citystitch"}


def test_a_view_leaves_logging_as_it_was() -> None:
    before = LOGGER.handlers.copy(), LOGGER.level
    for options in ({}, {"quiet": True}, {"verbose": True}):
        view = make_view(console=Console(file=io.StringIO()), **options)
        assert len(LOGGER.handlers) == len(before[0]) + 1
        view.end("done")
        assert (LOGGER.handlers, LOGGER.level) == before


def test_quietly_a_failure_that_ends_the_run_is_told_once(
    town: Town, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = run_words(town, tmp_path / "out", "--quiet")
    with patch("tiler.stages.domain.is_low", side_effect=InputError("wet; dry it")):
        assert main(words) == 1
    captured = capsys.readouterr()
    assert captured.err == "citystitch: seams: height of the domain: wet; dry it\n"
    assert captured.out == ""
    (event,) = [event for event in read_events(tmp_path / "out" / "events.jsonl") if event["event"] == "failed"]
    assert event["reason"] == "wet; dry it"
    with patch("tiler.stages.mesh.mesh_tile", side_effect=GeometryError("too thin")):
        assert main(words) == 1  # no tile is left
    assert capsys.readouterr().err.count("failed: mesh: columns of cells") == 4


@contextmanager
def terminal(term: str = "xterm-256color", **others: str) -> Iterator[tuple[Console, Callable[[], str]]]:
    """A console in a pseudo-terminal, and what it has shown when it is closed."""
    ours, theirs = pty.openpty()
    seen: list[bytes] = []

    def listen() -> None:
        try:
            while data := os.read(ours, 65536):
                seen.append(data)
        except OSError:  # all of the other side is closed
            pass

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    file = os.fdopen(theirs, "w", encoding="utf-8")

    def shown() -> str:
        file.close()
        listener.join(10)
        return b"".join(seen).decode()

    try:
        environment = {"TERM": term, "COLUMNS": "80", "LINES": "24"} | others
        yield Console(file=file, highlight=False, _environ=environment), shown
    finally:
        file.close()
        listener.join(10)
        os.close(ours)


def show(console: Console, tmp_path: Path, **options: bool) -> None:
    """A short run, with all that can happen."""
    watchers = Watchers([RunLog(), make_view(console=console, **options)])
    watchers.say("before it begins")
    watchers.begin(start_of(tmp_path))
    do(watchers, "points", range(1), 1)
    do(watchers, "columns", range(1), 2, notes={"odd": 1})
    watchers.submitted("columns", "1_0")
    time.sleep(1.2)
    watchers.say("a sentence with \x1b[31m signs")
    watchers.failed("columns", "1_0", "it is [bold]wet[/]")
    watchers.end("failed")


def test_the_live_view_in_a_terminal(tmp_path: Path) -> None:
    with terminal() as (console, shown):
        show(console, tmp_path)
        text = shown()
    assert text.startswith("before it begins")
    assert text.index(HIDE) < text.index("1 warning") < text.rindex(SHOW)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)
    assert "  points            1 task       1.00 s" in plain
    assert re.search(r"  mesh +━+─+ +1/2 ", plain)
    assert "a sentence with \\x1b[31m signs" in plain
    assert "failed: mesh: columns of cells 1_0: it is [bold]wet[/]" in plain
    assert COLOUR.search(text)
    # What stays at the end is the lines: the view is wiped row by row before the last of them.
    assert text.rindex("\x1b[2K") < text.rindex("a sentence with")


def test_colours_are_left_out_where_nobody_wants_them(tmp_path: Path) -> None:
    with terminal(NO_COLOR="1") as (console, shown):
        show(console, tmp_path)
        text = shown()
    assert not re.search(r"\x1b\[(?:[0-9;]*;)?3[0-9]m", text)
    assert "━" in text
    assert "─" in text


def test_a_dumb_terminal_gets_lines_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with terminal(term="dumb") as (console, shown):
        show(console, tmp_path)
        assert shown() == ""  # lines go to standard output
    assert capsys.readouterr().out.splitlines() == [
        "before it begins",
        "  points            1 task       1.00 s",
        "a sentence with \\x1b[31m signs",
        "failed: mesh: columns of cells 1_0: it is [bold]wet[/]",
    ]


def test_no_terminal_gets_lines_alone(tmp_path: Path) -> None:
    view = make_view(console=Console(file=io.StringIO(), force_terminal=True))
    assert isinstance(view, LogView)
    view.end("done")


def test_a_view_that_is_told_by_a_signal_does_not_wait(tmp_path: Path) -> None:
    """A handler speaks while the main thread holds the console: the line waits for the drawing thread."""
    with terminal() as (console, shown):
        view = Watchers([RunLog(), LiveView(console)])
        view.begin(start_of(tmp_path))
        handler = signal.signal(signal.SIGUSR1, lambda *_: view.say("from the handler"))
        try:
            with console._lock:
                os.kill(os.getpid(), signal.SIGUSR1)
                time.sleep(0.6)
        finally:
            signal.signal(signal.SIGUSR1, handler)
        view.end("done")
        assert "from the handler" in shown()


def run_words(town: Town, out: Path, *words: str) -> list[str]:
    given = ["run", str(town.folder / "tiles"), "--footprints", str(town.folder / "footprints.gpkg")]
    return [*given, "--out", str(out), "--tile-size", "140", "--domain-height", "70", *words]


def test_the_options_of_the_command(town: Town, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All results are there: what is said of them is what counts. No option is a parameter of the run."""
    out, log = town.copy(tmp_path / "out"), tmp_path / "log.jsonl"
    assert main(run_words(town, out, "--verbose", "--log-json", str(log))) == 0
    text = capsys.readouterr().out
    assert "    mesh: columns of cells 2271_45707  was there\n" in text
    assert "  mesh              4 tasks      0.00 s\n" in text
    assert "\n0 of " in text, text
    assert [line.strip() for line in text.splitlines()[-4:]] == [
        f"next: citystitch check {out}",
        f"citystitch report {out}",
        f"citystitch render {out} -o city.png",
        f"citystitch export {out} --format openfoam -o case",
    ]
    assert re.search(r"distance to the model \(RMSE\): roof points 0\.\d\d m, ground points 0\.\d\d m\n", text)
    without_time = [[event | {"t": 0} for event in read_events(path)] for path in (log, out / "events.jsonl")]
    assert without_time[0] == without_time[1]
    assert "log" not in (out / "config.toml").read_text()
    assert main(run_words(town, out, "--quiet")) == 0
    captured = capsys.readouterr()
    assert re.fullmatch(rf"[\d,]+ cells in {out}, [\d.]+ s\n", captured.out)
    assert captured.err == ""


def test_wrong_options_are_told(town: Town, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = run_words(town, tmp_path / "out")
    with pytest.raises(SystemExit) as ended:
        main([*words, "--quiet", "--verbose"])
    assert ended.value.code == 2
    for more, reason in (
        (["--log-json", str(tmp_path / "out" / "events.jsonl")], "lies among the results"),
        (["--log-json", str(tmp_path / "out" / "store.zarr" / "x")], "lies among the results"),
        (["--log-json", str(town.folder / "footprints.gpkg")], "is there, and no log of events"),
        (["--log-json", str(tmp_path / "x"), "--only", "2271_45707"], "leave out it or --only"),
    ):
        capsys.readouterr()
        assert main([*words, *more]) == 2
        assert reason in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_run_that_cannot_begin_is_in_the_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log"
    words = ["run", str(tmp_path / "none.laz"), "--out", str(tmp_path / "out"), "--quiet", "--log-json", str(log)]
    code = main(words)
    assert code != 0
    (event,) = read_events(log)
    assert (event["event"], event["status"]) == ("run", "failed")
    assert capsys.readouterr().err == f"citystitch: {event['error']}\n"
    assert kinds(log) == ["run"]


def test_libraries_are_silent(tmp_path: Path) -> None:
    """Warnings of libraries are not for the user, in the driver or in workers; -W brings them back."""
    code = "import warnings, sys; from tiler.cli.main import main; sys.argv = ['citystitch', 'config']; main();"
    code += 'import os; os.system(f"{sys.executable} -c \'import warnings; warnings.warn(\\"child\\")\'");'
    code += "warnings.warn('driver')"
    for options, seen in (([], False), (["-W", "default"], True)):
        process = subprocess.run(
            [sys.executable, *options, "-c", code], capture_output=True, text=True, check=True
        )
        assert ("driver" in process.stderr) is seen
        assert "child" in process.stderr if seen else process.stderr == ""


def test_logs_of_libraries_are_silent() -> None:
    """Dask tells of closed connections after its cluster has let go of its logs; others are as open."""
    code = "import logging, sys; from tiler.cli.main import main; sys.argv = ['citystitch', 'config']; main();"
    code += "import distributed; names = ['distributed.batched', 'distributed.client', 'tornado', 'asyncio'];"
    code += "[logging.getLogger(name).critical('said by %s', name) for name in names]"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stderr == ""


def in_tmux(words: list[str], width: int, folder: Path) -> Iterator[str]:
    """Run a command in a terminal of tmux; gives what its screen shows, again and again, and at the end all."""
    server, done = f"citystitch-{os.getpid()}-{width}", folder / "done"
    tmux = ["tmux", "-L", server]
    script = folder / "script"
    line = " ".join(f"'{word}'" for word in words)
    # A program believes COLUMNS before its terminal, and tmux may size a window when its program has begun.
    ready = f"unset COLUMNS LINES\nuntil [ \"$(stty size)\" = '24 {width}' ]; do sleep 0.1; done\n"
    begin = f"cd '{ROOT}'\nexport LANG=C.UTF-8\n{ready}"
    script.write_text(f"{begin}{line}\necho code $?\ntouch {done}\nsleep 600\n")
    size = ["-x", str(width), "-y", "24"]
    run_program([*tmux, "-u", "-f", "/dev/null", "new-session", "-d", *size, f"bash {script}"], folder)
    try:
        run_program([*tmux, "set-option", "-g", "window-size", "manual"], folder)
        run_program([*tmux, "resize-window", *size], folder)
        end = time.monotonic() + 280
        while not done.exists():
            assert time.monotonic() < end
            yield run_program([*tmux, "capture-pane", "-p"], folder)
            time.sleep(0.3)
        time.sleep(0.5)
        yield run_program([*tmux, "capture-pane", "-p", "-S", "-200"], folder)
    finally:
        run_program([*tmux, "kill-server"], folder)


@pytest.mark.long
@pytest.mark.parametrize("width", [80, 200])
def test_a_run_in_a_terminal_looks_right(town: Town, tmp_path: Path, width: int) -> None:
    words = run_words(town, tmp_path / "out", "--workers", "2", "--mesh-size", "1.5")  # takes some seconds
    screens = list(in_tmux([sys.executable, "-m", "tiler.cli.main", *words], width, tmp_path))
    views = [rows for screen in screens[:-1] if "in hand" in screen for rows in [screen.rstrip().split("\n")]]
    assert len(views) > 3, screens[-1]
    bar = min(60, width - 58)
    for rows in views:
        assert re.fullmatch(rf"  all {{14}}[━─]{{{bar}}} +\d+%.* \d+ of 7 steps", rows[-2])
        assert re.fullmatch(r"  0:\d\d:\d\d, 2 workers, \d+ tasks? in hand.*", rows[-1])
        # One view, and above it nothing but finished stages and stages at work: no row was wrapped or left behind.
        assert sum("in hand" in row and "workers" in row for row in rows) == 1
        for row in rows[:-2]:
            done, at_work = r"  [a-z]+ +\d+ tasks? +[\d.]+ s", rf"  [a-z0-9-]+ +[━─]{{{bar}}} +[\d,]+/[\d,]+.*"
            assert re.fullmatch(f"{done}|{at_work}|  and \\d+ more steps at work|[^ ].*", row), row
    assert any("━" in rows[0] or "─" in rows[0] for rows in views)
    assert any("~ " in rows[-2] for rows in views) or len(views) < 20
    last = screens[-1].rstrip().split("\n")
    assert last[-1] == "code 0"
    text = "\n".join(last)
    assert "━" not in text
    assert "─" not in text
    assert len(re.findall(r"^  [a-z]+ +\d+ tasks? +[\d.]+ s$", text, re.MULTILINE)) == 7
    assert "quality, percentile" in text
    assert " cells, " in text


@pytest.mark.long
def test_ctrl_c_on_the_keyboard_stops_and_leaves_a_whole_terminal(town: Town, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ours, theirs = pty.openpty()
    words = [sys.executable, "-m", "tiler.cli.main", *run_words(town, out, "--workers", "2")]
    process = subprocess.Popen(
        ["setsid", "-c", *words], stdin=theirs, stdout=theirs, stderr=theirs, env={**os.environ, "TERM": "xterm"}
    )
    os.close(theirs)
    seen, pressed = b"", False
    try:
        while True:
            # The screen is written now and then: a run of few tiles may be done before it is again.
            if select.select([ours], [], [], 0.002)[0]:
                data = os.read(ours, 65536)
                if not data:
                    break
                seen += data
            if not pressed and list((out / "store.zarr" / "ground").glob("[!.]*")):
                os.write(ours, b"\x03")
                pressed = True
    except OSError:
        pass
    os.close(ours)
    text = seen.decode()
    assert process.wait(60) == 130, text
    assert "stopping when what runs is done; once more ends at once" in text
    assert "the same command goes on" in text.split(SHOW)[-1]
    assert "Traceback" not in text
    assert text.count(HIDE) == text.count(SHOW) == 1
