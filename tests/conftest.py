"""Fixtures that all tests share."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"


def pytest_configure() -> None:
    """Write bytecode and let interrupts through, whatever the shell says.

    Without bytecode each of the many processes that tests start would compile all packages anew: 0.8 s of
    processor time each. What a shell starts in the background ignores interrupts, and so do its children.
    """
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile kernels before tests begin, on two cores: the first test with a time limit would have to."""
    from tiler.executors.kernels import are_compiled

    if not hasattr(session.config, "workerinput") and not are_compiled():
        command = [sys.executable, "-m", "tiler.cli.main", "kernels"]
        subprocess.run(command, stdout=subprocess.DEVNULL, cwd=ROOT, check=False)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real data; a test that needs it is skipped, saying so, where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"no real data at {SHARED}")
    return SHARED


@pytest.fixture
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw pictures and those of reports of few pixels, for time."""
    from tiler.pictures.render import SIZES

    monkeypatch.setattr("tiler.report.pictures.SIZE", (112, 70))
    for what in SIZES:
        monkeypatch.setitem(SIZES, what, (300, 150))


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finished run of a synthetic city on four tiles, not to be changed."""
    from tiler.config.config import make_config
    from tiler.interface.synth import write_city
    from tiler.workflow.run import run

    folder = tmp_path_factory.mktemp("small")
    files = write_city(folder / "city", size=300, buildings=15, density=1.0)
    given = {
        "pointcloud": [str(path) for path in files.clouds],
        "footprints": str(files.footprints),
        "out": str(folder / "out"),
        "tile_size": 150.0,
        "domain_height": 60.0,
    }
    run(make_config(given))
    return folder / "out"


@pytest.fixture(scope="session")
def sloped_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finished run of a synthetic city with roofs of all types on four tiles, not to be changed."""
    from tiler.config.config import make_config
    from tiler.interface.synth import write_city
    from tiler.workflow.run import run

    folder = tmp_path_factory.mktemp("sloped")
    files = write_city(folder / "city", size=280, buildings=24, density=3.0, relief=6, seed=5, roofs="mixed")
    given = {
        "pointcloud": [str(path) for path in files.clouds],
        "footprints": str(files.footprints),
        "out": str(folder / "out"),
        "roofs": "planes",
        "tile_size": 150.0,
        "domain_height": 60.0,
    }
    run(make_config(given))
    return folder / "out"


@pytest.fixture(scope="session")
def amsterdam_run(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finished run of central Amsterdam on four tiles, not to be changed."""
    return run_amsterdam(shared_data, tmp_path_factory.mktemp("amsterdam") / "out", tile_size=300.0)


@pytest.fixture(scope="session")
def amsterdam_blocks_run(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finished run of some blocks of Amsterdam on four tiles, for solvers; not to be changed."""
    bounds = [120_750.0, 486_000.0, 121_050.0, 486_300.0]
    return run_amsterdam(shared_data, tmp_path_factory.mktemp("blocks") / "out", tile_size=150.0, bounds=bounds)


def run_amsterdam(shared_data: Path, out: Path, **given: Any) -> Path:
    """Mesh central Amsterdam; gives the folder of the run."""
    from tiler.config.config import make_config
    from tiler.workflow.run import run

    data = shared_data / "amsterdam"
    clouds = [str(path) for path in sorted((data / "tiles").iterdir())]
    inputs = {"pointcloud": clouds, "footprints": str(data / "footprints.gpkg"), "out": str(out)}
    run(make_config(inputs | given))
    return out
