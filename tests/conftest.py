"""Fixtures that all tests share."""

import fcntl
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Once = Callable[[str, Callable[[Path], object]], Path]
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
def once(tmp_path_factory: pytest.TempPathFactory) -> Once:
    """Fill a folder, in the first of pytest's processes that asks for it; nothing in it is to be changed."""
    home = tmp_path_factory.getbasetemp()
    home = home.parent if "PYTEST_XDIST_WORKER" in os.environ else home

    def fill(name: str, make: Callable[[Path], object]) -> Path:
        folder = home / name
        with (home / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (folder / "filled").exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                (folder / "filled").touch()
        return folder

    return fill


@pytest.fixture(scope="session")
def small_run(once: Once) -> Path:
    """Finished run of a synthetic city on four tiles."""
    from tests.helpers.synthetic import run_city

    return once("small", run_city) / "out"


@pytest.fixture(scope="session")
def sloped_run(once: Once) -> Path:
    """Finished run of a synthetic city with roofs of all types on four tiles."""
    from tests.helpers.synthetic import run_city

    city = {"size": 280, "buildings": 24, "density": 3.0, "relief": 6, "seed": 5, "roofs": "mixed"}
    return once("sloped", lambda folder: run_city(folder, city, roofs="planes")) / "out"


@pytest.fixture(scope="session")
def amsterdam_run(shared_data: Path, once: Once) -> Path:
    """Finished run of central Amsterdam on four tiles."""
    return once("amsterdam", lambda folder: run_amsterdam(shared_data, folder / "out", tile_size=300.0)) / "out"


@pytest.fixture(scope="session")
def amsterdam_blocks_run(shared_data: Path, once: Once) -> Path:
    """Finished run of some blocks of Amsterdam on four tiles, for solvers."""
    given: dict[str, Any] = {"tile_size": 150.0, "bounds": [120_750.0, 486_000.0, 121_050.0, 486_300.0]}
    return once("blocks", lambda folder: run_amsterdam(shared_data, folder / "out", **given)) / "out"


def run_amsterdam(shared_data: Path, out: Path, **given: Any) -> None:
    """Mesh central Amsterdam."""
    from tiler.config.config import make_config
    from tiler.workflow.run import run

    data = shared_data / "amsterdam"
    clouds = [str(path) for path in sorted((data / "tiles").iterdir())]
    run(make_config({"pointcloud": clouds, "footprints": str(data / "footprints.gpkg"), "out": str(out)} | given))
