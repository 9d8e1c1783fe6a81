"""Bad inputs from seeds: documented exit codes, one line, no crash, no hang, nothing written elsewhere.

Each family changes the files or the command line of a tiny city by a seeded generator: case k of a family is the
same on every machine. The everyday tests take the first cases of each, `pytest -m long` more, `make reliability`
all and keeps the outcomes as ``fuzz-input.json`` (`tests.helpers.campaigns`).
"""

import json
import os
import shutil
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.helpers.bad_input import BOUNDS, CODES, HOUSE, QUICK, write_city, write_houses, write_parquet
from tests.helpers.campaigns import ALL_ROUNDS, FOLDER
from tests.helpers.fuzz_worker import HUNG, Worker
from tests.tiler.stages.test_ingest import write_copc
from tiler.config.config import Config

LIMIT = 100.0  # s a call may take on a busy machine that compiles kernels first; most take half a second
FEW, MANY = 10, 60 if ALL_ROUNDS else 8  # cases of a family in the everyday tests and in the campaign
Rng = np.random.Generator

# Fixed fields of a LAS header: place and form.
FIELDS = [
    (4, "H"), (6, "H"), (24, "B"), (25, "B"), (94, "H"), (96, "I"), (100, "I"), (104, "B"), (105, "H"), (107, "I"),
    (111, "I"), *((131 + 8 * k, "d") for k in range(12)), (227, "Q"), (235, "Q"), (243, "I"), (247, "Q"),
    (255, "Q"),
]  # fmt: skip
NUMBERS = [
    float("nan"),
    float("inf"),
    -float("inf"),
    0.0,
    -0.0,
    1e-300,
    1e300,
    -1e300,
    1e9,
    -1.0,
    5e-324,
    318030.0,
]


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny city in every format that is read."""
    folder = write_city(tmp_path_factory.mktemp("fuzz") / "city")
    las = laspy.read(folder / "cloud.laz")
    las.write(folder / "cloud.las")
    rng = np.random.default_rng(1)
    some = rng.choice(len(las.points), 400, replace=False)
    write_copc(
        folder / "cloud.copc.laz",
        las.xyz[some],
        np.asarray(las.classification)[some],
        origin=np.array([*BOUNDS[:2], 0.0]),
    )
    houses = [
        HOUSE,
        shapely.box(318006, 6399006, 318014, 6399014).difference(shapely.box(318008, 6399008, 318010, 6399010)),
    ]
    for suffix in ("gpkg", "geojson", "shp", "fgb"):
        (folder / f"house.{suffix}").unlink(missing_ok=True)
        write_houses(folder / f"house.{suffix}", houses)
    write_parquet(folder / "house.parquet", [shapely.to_wkb(house) for house in houses])
    return folder


# Families: each changes the files of a city in place.


def flip_bytes(path: Path, rng: Rng, *, first: int = 0, stop: int | None = None) -> None:
    """Change one to sixteen bytes anywhere, or cut the file, or double a part of it."""
    data = bytearray(path.read_bytes())
    stop = len(data) if stop is None else min(stop, len(data))
    way = rng.integers(10)
    if way == 0:
        data = data[: rng.integers(first, stop)]
    elif way == 1:
        a, b = sorted(rng.integers(first, stop, 2).tolist())
        data = data[:b] + data[a:]
    elif way == 2:
        a = int(rng.integers(first, stop))
        data[a : a + int(rng.integers(1, 64))] = b"\xff" * int(rng.integers(1, 64))
    else:
        for place in rng.integers(first, stop, int(2 ** rng.uniform(0, 4))).tolist():
            data[place] = int(rng.integers(256))
    path.write_bytes(data)


def edit_field(path: Path, rng: Rng) -> None:
    """Put an absurd value into one or two fields of a LAS header."""
    data = bytearray(path.read_bytes())
    for _ in range(int(rng.integers(1, 3))):
        place, form = FIELDS[rng.integers(len(FIELDS))]
        if form == "d":
            value: float = NUMBERS[rng.integers(len(NUMBERS))]
        else:
            bits = 8 * struct.calcsize(form)
            value = [0, 1, 2**bits - 1, 2 ** (bits - 1), len(data), int(rng.integers(2**31)) % 2**bits][
                rng.integers(6)
            ]
            value = int(value) % 2**bits
        struct.pack_into("<" + form, data, place, value)
    path.write_bytes(data)


def flip_records(path: Path, rng: Rng) -> None:
    flip_bytes(path, rng, first=375, stop=375 + 54 + 200)


def change_json(path: Path, rng: Rng) -> None:
    """Replace, remove or nest a value somewhere in a JSON document."""
    document = json.loads(path.read_text())
    node: Any = document
    for _ in range(int(rng.integers(1, 9))):
        inner = node.values() if isinstance(node, dict) else node
        below = [value for value in inner if isinstance(value, (dict, list)) and value]
        if not below:
            break
        node = below[rng.integers(len(below))]
    keys = list(node) if isinstance(node, dict) else list(range(len(node)))
    key = keys[rng.integers(len(keys))]
    deep: Any = []
    for _ in range(int(rng.integers(1, 600))):
        deep = [deep]
    values = [
        None,
        [],
        {},
        "",
        "\x1b[31m",
        -1,
        1e308,
        float("nan"),
        float("inf"),
        10**400,
        True,
        deep,
        "x" * 100_000,
    ]
    if rng.integers(4) == 0:
        del node[key]
    else:
        node[key] = values[rng.integers(len(values))]
    path.write_text(json.dumps(document))


def change_shapefile(path: Path, rng: Rng) -> None:
    """Change or remove one of the files of a shapefile."""
    part = path.with_suffix((".shp", ".shx", ".dbf", ".prj", ".shp", ".dbf")[rng.integers(6)])
    if rng.integers(8) == 0:
        part.unlink()
    else:
        flip_bytes(part, rng)


def change_wkb(path: Path, rng: Rng) -> None:
    """Put changed well-known binary into a GeoPackage."""
    from tests.helpers.bad_input import put_wkb

    shapes = [HOUSE, shapely.MultiPolygon([HOUSE]), shapely.GeometryCollection([HOUSE, HOUSE.exterior])]
    data = bytearray(shapely.to_wkb(shapes[rng.integers(3)]))
    for place in rng.integers(0, 30, 3).tolist():
        data[place] = int(rng.choice([0, 1, 2, 3, 6, 7, 8, 10, 15, 17, 127, 128, 255]))
    put_wkb(path, bytes(data) if rng.integers(3) else bytes(data) * int(rng.integers(2, 200)))


FAMILIES: dict[str, tuple[str, str, Callable[[Path, Rng], None]]] = {
    "LAS header": ("cloud.las", "", edit_field),
    "LAZ header": ("cloud.laz", "", edit_field),
    "COPC header": ("cloud.copc.laz", "", edit_field),
    "LAS records": ("cloud.las", "", flip_records),
    "LAZ records": ("cloud.laz", "", flip_records),
    "COPC records": ("cloud.copc.laz", "", flip_records),
    "LAZ bytes": ("cloud.laz", "", flip_bytes),
    "COPC bytes": ("cloud.copc.laz", "", flip_bytes),
    "GPKG bytes": ("", "house.gpkg", flip_bytes),
    "GPKG geometries": ("", "house.gpkg", change_wkb),
    "GeoJSON bytes": ("", "house.geojson", flip_bytes),
    "GeoJSON values": ("", "house.geojson", change_json),
    "Shapefile bytes": ("", "house.shp", change_shapefile),
    "FlatGeobuf bytes": ("", "house.fgb", flip_bytes),
    "GeoParquet bytes": ("", "house.parquet", flip_bytes),
}


class Tally:
    """Counts outcomes, and asserts what holds of each."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.outcomes: dict[str, Counter[int]] = {}
        self.slowest: dict[str, float] = {}
        self.faults: list[str] = []

    def call(self, worker: Worker, case: Path, family: str, seed: Any, arguments: list[str]) -> None:
        """Call the command line on one case; what should not be is listed as a fault."""
        before = listing(case)
        found = worker.call(*arguments)
        self.outcomes.setdefault(family, Counter())[found.code] += 1
        self.slowest[family] = max(self.slowest.get(family, 0.0), found.seconds)
        why = fault(found.code, found.err)
        if not why and (listing(case) != before or any(worker.folder.iterdir())):
            why = "wrote beside the output folder"
        if why:
            self.faults.append(
                f"{family}, case {seed}: {why}\n  {' '.join(arguments)[:500]}\n  {found.err[:1500]}"
            )

    def write(self) -> None:
        """Write the outcomes as JSON where the environment asks for it."""
        place = os.environ.get(FOLDER)
        if not place:
            return
        path = Path(place) / "fuzz-input.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        record = json.loads(path.read_text()) if path.exists() else {}
        for family, codes in self.outcomes.items():
            record[family] = {
                "cases": sum(codes.values()),
                "codes": {str(code): n for code, n in sorted(codes.items())},
                "slowest": round(self.slowest[family], 1),
            }
        path.write_text(json.dumps(dict(sorted(record.items())), indent=1) + "\n")


def fault(code: int, err: str) -> str:
    """Say what is wrong with an outcome, "" if nothing is."""
    lines = [line for line in err.splitlines() if line]
    usage = bool(lines) and lines[0].startswith("usage:")
    one = len(lines) == 1 and lines[0].startswith("citystitch: ")
    faults = {
        "hung": code == HUNG,
        f"exit code {code}": code not in CODES,
        "a traceback": "Traceback" in err,
        "usage with another exit code": usage and code != 2,
        "an error that nobody foresaw": "--traceback tells where" in err,
        f"{len(lines)} lines": code in {1, 2} and not usage and not one,
        "words on stderr": code in {0, 3} and bool(lines),
    }
    return next((why for why, is_so in faults.items() if is_so), "")


def listing(case: Path) -> dict[str, tuple[int, int]]:
    """Sizes and times of all files of a case but the output folder."""
    found = (path for path in case.rglob("*") if (case / "out") not in (path, *path.parents))
    return {str(path): (path.lstat().st_size, path.lstat().st_mtime_ns) for path in found if not path.is_dir()}


@pytest.fixture(scope="module")
def worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Worker]:
    with Worker(tmp_path_factory.mktemp("empty"), limit=LIMIT) as running:
        yield running


def play(originals: Path, tmp_path: Path, worker: Worker, n: int, families: list[str]) -> Tally:
    """Run cases 0 to n of families."""
    tally = Tally(tmp_path)
    for family in families:
        cloud, houses, change = FAMILIES[family]
        number = list(FAMILIES).index(family)
        for k in range(n):
            case = tmp_path / "case"
            shutil.copytree(originals, case)
            name = cloud or houses
            change(case / name, np.random.default_rng([number, k]))
            inputs = [str(case / (cloud or "cloud.laz")), "--footprints", str(case / (houses or "house.gpkg"))]
            command = ["run", *inputs, "--out", str(case / "out"), *QUICK, "--id-attribute", "id"]
            if k % 3 == 1:
                command += ["--bounds", *map(str, (BOUNDS[0] + 3, BOUNDS[1] + 3, BOUNDS[0] + 25, BOUNDS[3] - 3))]
            tally.call(worker, case, family, k, command)
            shutil.rmtree(case)
    return tally


def test_some_of_each_family(originals: Path, tmp_path: Path, worker: Worker) -> None:
    tally = play(originals, tmp_path, worker, 1, list(FAMILIES))
    assert not tally.faults, "\n".join(tally.faults)
    total = sum(tally.outcomes.values(), Counter[int]())
    assert total[1] > 5, total  # most are bad indeed


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("family", FAMILIES)
def test_all_of_each_family(originals: Path, tmp_path: Path, worker: Worker, family: str) -> None:
    tally = play(originals, tmp_path, worker, MANY, [family])
    tally.write()
    assert not tally.faults, "\n".join(tally.faults)


# Configurations and command lines by hypothesis

NAMES = [name for name in Config.__dataclass_fields__ if name not in {"cluster", "out", "scheduler", "workers"}]
SECTIONS = {name: entry.metadata["section"] for name, entry in Config.__dataclass_fields__.items()}
TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=30)
SCALARS = st.one_of(
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.booleans(),
    TEXT,
    st.sampled_from(
        [0, 1, 10.0, 20.0, 1e-9, "EPSG:3006", "EPSG:28992", "clip", "layered", "paper", "", "../x", "/"]
    ),
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=5) | st.dictionaries(TEXT, inner, max_size=3), max_leaves=8
)

# Values of the type that a parameter wants: most of them within its bounds.
LIKELY: dict[type, st.SearchStrategy[Any]] = {
    bool: st.booleans(),
    int: st.sampled_from([0, 1, 3, 20, 21]),
    float: st.sampled_from([0, 0.1, 0.5, 1, 2.5, 10.0, 20.0, 25.0, 90.0, 150.0, 1000.0, 1e6, 1e-6, 1e300]),
    str: st.sampled_from(
        ["", "id", "house", "EPSG:3006", "EPSG:4326", "median", "clip", "paper", "layered", "fem"]
    ),
}


def toml(value: Any) -> str:
    """Write a value as TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml(str(key))} = {toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value).replace("\x7f", "\\u007f") if isinstance(value, str) else repr(value)


@st.composite
def configurations(draw: Any) -> str:
    """Texts of a configuration: known and unknown parameters of any values, at times broken."""
    tables: dict[str, list[str]] = {"input": ['pointcloud = "cloud.laz"', 'footprints = "house.gpkg"']}
    for name in draw(st.lists(st.sampled_from(NAMES), unique=True, min_size=1, max_size=4)):
        lines = tables.setdefault(SECTIONS[name], [])
        lines[:] = [line for line in lines if not line.startswith(f"{name} ")]
        likely = LIKELY.get(type(getattr(Config(), name)))
        lines.append(
            f"{name} = {toml(draw(VALUES if likely is None or draw(st.integers(0, 3)) == 0 else likely))}"
        )
    if draw(st.integers(0, 9)) == 0:
        tables.setdefault(draw(TEXT), []).append(f"{toml(draw(TEXT))} = {toml(draw(SCALARS))}")
    text = "\n".join(
        f"[{key if key.isalpha() and key.isascii() else toml(key)}]\n" + "\n".join(rows)
        for key, rows in tables.items()
    )
    place = draw(st.integers(0, 10 * len(text)))
    return text[:place] + draw(TEXT) + text[place + draw(st.integers(0, 3)) :] if place < len(text) else text


PLAIN = st.one_of(
    st.sampled_from(
        [
            "nan",
            "inf",
            "-1",
            "0",
            "1e308",
            "1e-308",
            "20",
            "",
            "abc",
            "\x1b[31m",
            "[bold]",
            "[/]",
            "-",
            "--",
            "9" * 5000,
        ]
    ),
    TEXT.filter(lambda text: "\0" not in text),
)


@st.composite
def command_lines(draw: Any) -> list[str]:
    """Options with any values behind `plan` and the inputs; sometimes another command, or none."""
    command = draw(st.sampled_from(["plan"] * 8 + ["run", "check", "render", "export", "config", "nothing"]))
    words = [command] if command not in {"plan", "run"} else [command, "{cloud}"]
    for name in draw(st.lists(st.sampled_from(NAMES[1:]), max_size=3)):
        number = 4 if name == "bounds" else draw(st.sampled_from([1, 1, 1, 1, 0, 2]))
        words += [f"--{name.replace('_', '-')}", *(draw(PLAIN) for _ in range(number))]
    if command == "run":
        words += ["--tile-size", "nan"]  # never a mesh
    if draw(st.integers(0, 4)) == 0:
        words.append(draw(PLAIN))
    return words


def explore_configurations(originals: Path, tmp_path: Path, worker: Worker, n: int) -> Tally:
    """Plan runs by n configurations."""
    tally = Tally(tmp_path)

    @settings(
        max_examples=n, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck)
    )
    @given(configurations())
    def one(text: str) -> None:
        case = tmp_path / "case"
        shutil.rmtree(case, ignore_errors=True)
        case.mkdir()
        for name in ("cloud.laz", "house.gpkg"):
            shutil.copy2(originals / name, case / name)
        (case / "run.toml").write_text(text, encoding="utf-8")
        tally.call(worker, case, "TOML", repr(text), ["plan", str(case / "run.toml")])

    one()
    return tally


def explore_command_lines(originals: Path, tmp_path: Path, worker: Worker, n: int) -> Tally:
    """Call n command lines."""
    tally = Tally(tmp_path)
    case = tmp_path / "case"
    case.mkdir()
    shutil.copy2(originals / "cloud.laz", case / "cloud.laz")

    @settings(
        max_examples=n, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck)
    )
    @given(command_lines())
    def one(words: list[str]) -> None:
        arguments = [str(case / "cloud.laz") if word == "{cloud}" else word for word in words]
        tally.call(worker, case, "command lines", repr(words), arguments)

    one()
    return tally


EXPLORERS = {"TOML": explore_configurations, "command lines": explore_command_lines}


@pytest.mark.parametrize("name", EXPLORERS)
def test_some_words(originals: Path, tmp_path: Path, worker: Worker, name: str) -> None:
    tally = EXPLORERS[name](originals, tmp_path, worker, FEW)
    assert not tally.faults, "\n".join(tally.faults)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", EXPLORERS)
def test_all_words(originals: Path, tmp_path: Path, worker: Worker, name: str) -> None:
    tally = EXPLORERS[name](originals, tmp_path, worker, 5 * MANY)
    tally.write()
    assert not tally.faults, "\n".join(tally.faults)
    assert tally.outcomes[name][2] > MANY, tally.outcomes


def test_a_fault_is_found() -> None:
    """What the campaign calls a fault."""
    fine = "citystitch: a: b; c\n"
    assert not fault(0, "")
    assert not fault(1, fine)
    for code, err in ((1, ""), (1, fine * 2), (0, "warning"), (-11, ""), (HUNG, ""), (4, fine), (1, "Traceback")):
        assert fault(code, err)
    assert fault(1, "citystitch: ValueError: x; --traceback tells where")


def test_the_worker_survives_crash_and_hang(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A call that ends the process, and one that does not end, are told, and the next one works."""
    with Worker(tmp_path, limit=60.0) as running:
        assert running.call("config").code == 0
        assert running._process is not None
        running._process.kill()
        assert running.call("config").code == -9
        assert running.call("config").code == 0
        running.limit = 0.0
        assert running.call("config").code == HUNG
