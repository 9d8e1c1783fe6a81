"""The command line: what is meant where something is wrong, help in its order, output that breaks."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.bad_input import call, quick_run, write_city
from tiler.cli.main import main
from tiler.words.std_streams import _PatientWriter

Capture = pytest.CaptureFixture[str]
PROGRAM = [sys.executable, "-m", "tiler.cli.main"]


def test_the_version_is_told(capsys: Capture) -> None:
    found = call(capsys, "--version")
    assert found.code == 0
    assert found.out.startswith("citystitch ")


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["run", "a.laz", "--meshsize", "5"], "unknown option --meshsize; did you mean --mesh-size?"),
        (["run", "a.laz", "--mesh_size=5"], "unknown option --mesh_size; did you mean --mesh-size?"),
        (
            ["plan", "a.laz", "--footprint-file", "b"],
            "unknown option --footprint-file; did you mean --footprints?",
        ),
        (["export", "out", "--format", "vtu", "-o", "x", "--largest"], ""),  # an option's beginning will do
        (["export", "out", "--format", "opnfoam", "-o", "x"], "did you mean openfoam?"),
        (["chekc", "out"], "did you mean check?"),
        (["run", "a.laz", "--border", "clipp"], "did you mean clip?"),
        (["check", "out", "--colour"], "unknown option --colour\n"),
        (["check", "out", "another"], "unrecognized arguments: another"),
    ],
)
def test_what_was_meant_is_offered(capsys: Capture, words: list[str], meant: str) -> None:
    found = call(capsys, *words)
    assert meant in found.err
    assert found.code == (2 if meant else 1)


def test_parameters_of_a_file_are_offered_too(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "a.toml"
    for text, meant in (
        ("[mesh]\nmeshsize = 5", "unknown parameter meshsize in [mesh]; did you mean mesh_size?"),
        ("[run]\nmesh_size = 5", "unknown parameter mesh_size in [run]; it stands in [mesh]"),
        ("[meshes]\n", "unknown section [meshes]; did you mean mesh?"),
    ):
        path.write_text(text)
        found = call(capsys, "run", path)
        assert found.code == 2
        assert meant in " ".join(found.err.split())


@pytest.mark.parametrize(
    "command",
    [["check"], ["report"], ["render", "-o", "x.png"], ["export", "--format", "vtu", "-o", "x.vtu"]],
    ids=lambda words: words[0],
)
def test_a_folder_that_is_no_run_is_told_apart(tmp_path: Path, capsys: Capture, command: list[str]) -> None:
    (tmp_path / "photos").mkdir()
    for name, words in (("photos", "is not the folder of a run, it has no run.json"), ("none", "no such folder")):
        found = call(capsys, command[0], tmp_path / name, *command[1:])
        assert found.code == 1
        assert words in found.err
        assert found.err.count("\n") == 1


def test_help_begins_with_the_essentials_and_ends_with_research(capsys: Capture) -> None:
    text = call(capsys, "run", "--help").out
    titles = [line for line in text.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert titles[:3] == ["positional arguments:", "options:", "essentials:"]
    assert titles[-1].startswith("research")
    places = [text.index(f"\n  --{name} ") for name in ("footprints", "out", "mesh-size", "workers")]
    assert places == sorted(places)
    assert (
        max(places)
        < text.index("\n  --layer ")
        < text.index("\n  --dashboard-address ")
        < text.index("\n  --mesher ")
    )
    for metavar in ("--footprints FILE", "--out DIR", "--crs EPSG", "--mesh-size M"):
        assert metavar in text


def run_into_nothing(*words: str | Path, **environment: str) -> tuple[int, str]:
    """Run a command whose output nobody reads; its exit code and what it said of errors."""
    ours, theirs = os.pipe()
    os.close(ours)
    try:
        process = subprocess.run(
            [*PROGRAM, *map(str, words)],
            stdout=theirs,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            env=os.environ | environment,
        )
    finally:
        os.close(theirs)
    return process.returncode, process.stderr


def test_a_reader_that_has_gone_changes_no_exit_code(tmp_path: Path) -> None:
    city = write_city(tmp_path / "city")
    command = quick_run(city, tmp_path / "out")
    assert run_into_nothing(*command) == (0, "")
    assert run_into_nothing("check", tmp_path / "out") == (0, "")
    assert run_into_nothing("config") == (0, "")
    assert run_into_nothing("run", "--help") == (0, "")
    code, error = run_into_nothing("check", tmp_path)
    assert (code, error.startswith("citystitch: ")) == (1, True)


def test_an_ascii_terminal_changes_no_exit_code(tmp_path: Path) -> None:
    city = write_city(tmp_path / "city")
    out = tmp_path / "ausgabe für ß"
    command = quick_run(city, out)
    for words in (command, ["check", out], ["status", out], ["run", "--help"]):
        process = subprocess.run(
            [*PROGRAM, *map(str, words)],
            capture_output=True,
            check=False,
            env=os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PYTHONUTF8": "0"},
        )
        assert (process.returncode, process.stderr) == (0, b"")
        assert process.stdout.isascii()
    assert b"m3" in process.stdout or b"m2" in process.stdout


def test_a_patient_writer_writes(tmp_path: Path) -> None:
    with (tmp_path / "a").open("wb") as file:
        writer = _PatientWriter(file.fileno())
        assert (writer.write(b"abc"), writer.isatty(), writer.writable()) == (3, False, True)
    assert (tmp_path / "a").read_bytes() == b"abc"


def test_the_main_program_takes_arguments(capsys: Capture) -> None:
    assert main(["config"]) == 0
    assert "[mesh]" in capsys.readouterr().out
