"""The report: it says what record and store say, escapes what others wrote, and leaves every result as it was."""

import json
import re
import shutil
import sys
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipeline.city_model.heights import ROOF_SOURCES
from pipeline.data.errors import InputError
from pipeline.quality.histograms import share_below
from tests.helpers.tiles import hash_files
from tiler.cli.main import main
from tiler.report.charts import Series, draw_gantt, draw_histogram
from tiler.report.maps import draw_map, gather_tiles, shade
from tiler.report.record import SHOWN, read_run_facts
from tiler.report.samples import measure_samples
from tiler.report.svg_map import encode_png
from tiler.report.timeline import BINS, read_timeline
from tiler.report.write import write_report
from tiler.stages.domain import LOW_DOMAIN
from tiler.words.note_words import GROUPS, WORDS, group_of, say_notes

pytestmark = pytest.mark.usefixtures("small_pictures")  # `test_report_page` has those of a user
ROOT = Path(__file__).resolve().parents[3]
SAME_FOR_ALL: set[str] = set()
VOID = {"meta", "link", "img"}


class Reader(HTMLParser):
    """Reads a page: its text, elements, and whether each is closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def read(path: Path) -> Reader:
    reader = Reader()
    reader.feed(path.read_text(encoding="utf-8"))
    reader.close()
    assert reader.open == []
    return reader


@pytest.fixture
def copy(small_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(small_run, tmp_path / "run")


def change_record(out: Path, **members: object) -> None:
    record = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(record | members))


def test_the_report_says_what_the_run_made(copy: Path) -> None:
    before = hash_files(copy)
    page = read(write_report(copy))
    assert hash_files(copy) == before
    record = json.loads((copy / "run.json").read_text())
    words = " ".join(page.words)
    for count in ("cells", "points", "facets"):
        assert f"{record['counts'][count]:,}" in words
    assert f"{record['quality']['radius_ratio']['0']:.3f}" in words
    assert f"{record['fidelity']['roof']['rmse']:.3f}" in words
    for name, value in record["versions"].items():
        assert name in page.words
        assert value in page.words
    tiles = [
        attributes for tag, attributes in page.elements if tag == "rect" and "shade" in (attributes["class"] or "")
    ]
    assert len(tiles) == 3 * len(record["tiles"])  # by quality, cells and time


def test_the_report_tells_how_many_roof_points_are_close_to_the_mesh(
    sloped_run: Path, tmp_path: Path, small_pictures: None
) -> None:
    copy = shutil.copytree(sloped_run, tmp_path / "run")
    page = read(write_report(copy))
    bounds = json.loads((copy / "run.json").read_text())["region"]["bounds"]
    samples = measure_samples(copy, tuple(bounds), ground_filter=False)
    share = share_below(samples.points["roof on roof"].absolute, 0.25)
    assert 0.7 < share < 1.0
    row = page.words[page.words.index("roof points over roofs") :]
    assert row[7] == f"{share:.3f}"
    assert page.words.count("share within 0.25 m") == 3


def test_the_report_needs_no_other_file(copy: Path) -> None:
    page = read(write_report(copy))
    for tag, attributes in page.elements:
        for name in ("href", "src", "srcset", "xlink:href"):
            link = attributes.get(name)
            assert link is None or link.startswith(("#", "data:")), (tag, link)
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = {(attributes.get("href") or "")[1:] for tag, attributes in page.elements if tag == "a"}
    assert links
    assert links <= set(ids)
    assert "url(" not in (copy / "report.html").read_text().replace("url(#", "")
    assert not [tag for tag, _ in page.elements if tag == "script"]


def test_what_others_wrote_is_text(copy: Path) -> None:
    evil = '<script>alert("x")</script><img src=x onerror=y>\x1b[31m\u202e'
    items = [{"subject": evil, "detail": evil, "x": 1.0, "y": 2.0}]
    record = json.loads((copy / "run.json").read_text())
    change_record(
        copy,
        notes={evil: {"count": 1, "items": items}},
        messages=[evil],
        unreadable={evil: evil},
        missing={"0_0": {"stage": evil, "name": evil, "reason": evil, "command": evil}},
        set_aside=[{"stage": evil, "name": evil, "reason": evil}],
        versions={evil: evil},
        region=record["region"] | {"crs": evil},
        parameters=record["parameters"] | {"footprints": evil, "layer": evil},
    )
    with pytest.raises(InputError, match="a field is missing or wrong"):  # no tile of the region
        write_report(copy)
    name = sorted(record["tiles"])[0]
    change_record(copy, missing={name: {"stage": evil, "name": evil, "reason": evil, "command": evil}})
    page = read(write_report(copy))
    assert not [tag for tag, _ in page.elements if tag == "script"]
    assert not [attributes for _, attributes in page.elements if "onerror" in attributes]
    text = (copy / "report.html").read_text(encoding="utf-8")
    assert "\x1b" not in text
    assert "\u202e" not in text
    assert text.count("&lt;script&gt;") >= 12


def test_long_lists_are_cut_and_say_so(copy: Path) -> None:
    items = [{"subject": f"sliver{k}", "detail": "", "x": 0.0, "y": 0.0} for k in range(9_000)]
    change_record(copy, notes={"footprint-sliver": {"count": 12_345, "items": items}})
    page = read(write_report(copy))
    assert sum(bool(re.fullmatch(r"sliver\d+", words)) for words in page.words) == SHOWN
    assert f"The first {SHOWN} of 12,345 notes; run.json has more" in page.words


def test_a_failed_run_has_a_report_of_what_is_known(tmp_path: Path) -> None:
    record = {
        "schema": 1,
        "status": "failed",
        "error": "no <points>",
        "parameters": {"mesh_size": 4.0},
        "versions": {},
    }
    (tmp_path / "run.json").write_text(json.dumps(record))
    page = read(write_report(tmp_path))
    assert "The run failed: no <points>" in page.words
    assert [a["id"] for tag, a in page.elements if tag == "section"] == ["summary", "time", "notes", "parameters"]


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"status": "running"}, "the run is at work"),
        ({"schema": 7}, "schema 7, expected 1"),
        ({"region": {"bounds": [0, 0, 0]}}, "a field is missing or wrong"),
        ({"region": {"bounds": [5, 0, 1, 1], "crs": "", "tile_size": 1}}, "are no box"),
        ({"tiles": {"0_0": {}}}, "a field is missing or wrong"),
        ({"counts": {}}, "a field is missing or wrong"),
    ],
)
def test_a_broken_record_is_one_error(copy: Path, members: dict[str, object], words: str) -> None:
    change_record(copy, **members)
    with pytest.raises(InputError, match=words):
        write_report(copy)
    assert not (copy / "report.html").exists()


def test_the_command_writes_it_and_refuses_other_folders(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", str(copy)]) == 0
    assert capsys.readouterr().out.strip() == str(copy / "report.html")
    assert main(["report", str(tmp_path / "none")]) == 1
    (tmp_path / "empty").mkdir()
    assert main(["report", str(tmp_path / "empty")]) == 1
    shutil.rmtree(copy / "store.zarr")
    assert main(["report", str(copy)]) == 1
    assert "run again" in capsys.readouterr().err


def test_a_run_ends_with_its_report_if_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    city, out = tmp_path / "city", tmp_path / "out"
    assert main(["synth", str(city), "--size", "120", "--buildings", "3"]) == 0
    words = ["run", str(city / "tiles"), "--footprints", str(city / "footprints.shp"), "--out", str(out)]
    assert main([*words, "--report"]) == 0
    assert f"report: {out / 'report.html'}" in capsys.readouterr().out
    before = hash_files(out)
    page = read(out / "report.html")
    assert [a["id"] for tag, a in page.elements if tag == "section"][:3] == ["summary", "pictures", "map"]
    assert "When each step worked; the darker the more of its tasks at a time." in page.words
    assert main(words) == 0
    assert f"citystitch report {out}" in capsys.readouterr().out
    kept = (out / "report.html").read_text()  # nothing has changed
    assert "This report is old" not in kept
    assert hash_files(out) == before
    for _ in range(2):
        assert main([*words, "--roof-group", "1.0"]) == 0  # other roofs
        old = (out / "report.html").read_text()
        assert old.count("This report is old: it tells of an earlier run") == 1
        assert not list(out.glob(".report*"))
    assert main(words) == 0
    assert main(["report", str(out)]) == 0
    assert "This report is old" not in (out / "report.html").read_text()
    assert main(["check", str(out), "--store"]) == 0
    monkeypatch.setattr("tiler.report.write.collect_numbers", _fail)
    capsys.readouterr()
    assert main([*words, "--report"]) == 0  # the mesh is there
    assert "no report: it is night; citystitch report" in capsys.readouterr().err


def _fail(*_: object) -> None:
    raise InputError("it is night")


@pytest.mark.parametrize(("lost", "remedy"), [("pyvista", "pip install citystitch[pictures]"), ("EGL", "libegl1")])
def test_without_what_draws_the_page_says_so(
    copy: Path, monkeypatch: pytest.MonkeyPatch, lost: str, remedy: str
) -> None:
    if lost == "pyvista":
        monkeypatch.setitem(sys.modules, "pyvista", None)
    else:
        monkeypatch.setattr("tiler.pictures.render.has_graphics", lambda: False)
    page = read(write_report(copy))
    assert [words for words in page.words if remedy in words]
    assert not [tag for tag, _ in page.elements if tag == "img"]


def test_every_kind_of_note_is_explained() -> None:
    sources = "\n".join(
        path.read_text() for folder in ("pipeline", "tiler") for path in (ROOT / folder).rglob("*.py")
    )
    found = set(re.findall(r'(?:Note|note|_notes|_note)\(\s*"([a-z]+-[a-z-]+)"', sources))
    assert len(found) > 30
    assert found <= set(WORDS)
    for source in ROOF_SOURCES[1:-1]:
        assert group_of(f"footprint-roof-from-{source}") == "defaulted"
    assert LOW_DOMAIN in WORDS
    assert {words.group for words in WORDS.values()} == set(GROUPS)


@pytest.mark.parametrize("kind", WORDS)
def test_notes_have_grammar(kind: str) -> None:
    """One and many are sentences of their own, without a sign of how they are made."""
    one, many = say_notes(kind, 1), say_notes(kind, 5200)
    assert not re.search(r"[\[\]{}|]", one + many)
    if "{n}" in WORDS[kind].sentence:
        assert one.count("1 ") >= 1
        assert "5,200 " in many
        assert one.replace("1 ", "") != many.replace("5,200 ", "") or kind in SAME_FOR_ALL


def test_events_make_a_gantt_chart(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    rows: list[dict[str, object]] = [
        {"t": 100.0, "event": "run", "status": "running"},
        {"t": 101.0, "event": "done", "stage": "points", "name": "a", "seconds": 1.0, "reused": False},
        {"t": 104.0, "event": "done", "stage": "columns", "name": "0_0", "seconds": 2.0, "reused": False},
        {"t": 104.0, "event": "done", "stage": "columns", "name": "0_1", "seconds": 3.0, "reused": True},
        {"t": 105.0, "event": "failed", "stage": "columns", "name": "0_2", "reason": "x"},
        {"t": "no time", "event": "done", "stage": "columns"},
    ]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"t": 106, "event": "do')
    found = read_timeline(path, frozenset({"0_0", "0_1"}))
    assert found is not None
    assert (found.duration, found.stages) == (5.0, ("points", "mesh"))
    assert (found.tasks.tolist(), found.reused.tolist(), found.failed.tolist()) == ([1, 2], [0, 1], [0, 1])
    assert found.by_tile == {"0_0": 2.0, "0_1": 3.0}
    per_bin = 5.0 / BINS
    assert found.busy.sum(axis=1) * per_bin == pytest.approx([1.0, 5.0])
    assert found.busy[1, int(2.5 / per_bin)] == pytest.approx(2.0)  # both are at work then
    assert read_timeline(tmp_path / "none.jsonl", frozenset()) is None
    svg = draw_gantt("t", found.duration, found.stages, found.busy, ["", ""])
    assert len(re.findall('class="busy', svg)) == 3  # one task; one, then two


def test_many_tiles_are_drawn_as_blocks() -> None:
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(300), np.arange(200)))
    box = np.column_stack([i, j, i + 1, j + 1]).astype(np.float64) * 100.0
    value = np.ones(len(box))
    value[7] = 0.25
    names = [f"{a}_{b}" for a, b in zip(i.tolist(), j.tolist(), strict=True)]
    worst = gather_tiles(names, box, value, tile_size=100.0, least=True)
    assert (worst.tiles_along, len(worst.box)) == (8, 38 * 25)
    assert (worst.value == 0.25).sum() == 1
    assert worst.box.min(axis=0)[:2].tolist() == [0, 0]
    assert worst.box.max(axis=0)[2:].tolist() == [30_000, 20_000]
    total = gather_tiles(names, box, value, tile_size=100.0, least=False)
    assert total.value.sum() == pytest.approx(value.sum())
    svg = draw_map(
        "t", (0, 0, 30_000, 20_000), worst, limits=(1, 0), unit="", footprints=np.zeros((4, 4), np.uint8)
    )
    assert svg.count('<rect class="shade') == len(worst.box)
    assert len(svg) < 200_000


def test_shades_go_both_ways() -> None:
    assert shade(np.array([0.0, 10.0, 5.0]), (0, 10)).tolist() == [0, 6, 3]
    assert shade(np.array([0.7, 0.2, np.nan, 0.9]), (0.7, 0.2)).tolist() == [0, 6, -1, 0]


def test_a_picture_of_footprints_is_png() -> None:
    alpha = np.arange(12, dtype=np.uint8).reshape(3, 4)
    data = encode_png(alpha)
    with Image.open(BytesIO(data)) as image:
        rgba = np.asarray(image.convert("RGBA"))
    assert np.array_equal(rgba[..., 3], alpha)
    assert (rgba[..., :3] == 70).all()


def test_a_histogram_has_its_shares() -> None:
    svg = draw_histogram("t", "x", (0, 4), [Series("a", np.array([0.5, 0.5])), Series("b", np.array([1.0, 0.0]))])
    assert svg.count('class="series0"') == svg.count('class="series1"') == 1
    assert "100 %" in svg
    assert "<li>" in svg


def test_run_facts_hold_little_of_long_lists(copy: Path) -> None:
    items = [{"subject": "s", "detail": "", "x": float(k), "y": 0.0} for k in range(2_000)]
    change_record(copy, notes={"a": {"count": 2_000, "items": items}})
    (notes,) = read_run_facts(copy).notes
    assert (len(notes.items), len(notes.places), notes.count) == (SHOWN, 300, 2_000)


def test_roofs_of_planes_are_told_by_method_and_the_worst_are_listed(copy: Path) -> None:
    record = json.loads((copy / "run.json").read_text())
    fit = {
        "planes": {"buildings": 1234, "points": 56789, "rmse": 1.25, "median": 0.125, "within": 0.75},
        "family": {"buildings": 5, "points": 3 * 56789, "rmse": 0.25, "median": 0.5, "within": 0.5},
        "flat": {"buildings": 4321, "points": 0},
    }
    worst = {
        **{"id": "<h1>", "method": "planes", "parts": 3, "points": 77, "rmse": 9.875, "within": 0.25},
        **{"worst_part": "h1-part2", "x": 12.5, "y": 7.0, "why": "few & far"},
    }
    full = {"planes": {"buildings": 77, "points": 99, "rmse": 2.5, "median": 0.125, "within": 0.875}}
    told = {"roof_fit": fit, "worst_roofs": [worst], "full_roof_fit": full}
    change_record(copy, fidelity=record["fidelity"] | told)
    words = read(write_report(copy)).words
    for word in ("1,234", "56,789", "1.250", "0.125", "0.750", "4,321", "<h1>", "9.875"):
        assert word in words
    total = words[words.index("all") + 1 :]
    assert total[:5] == ["5,560", "227,156", f"{(1.75 / 4) ** 0.5:.3f}", "-", f"{2.25 / 4:.3f}"]
    total = words[words.index("all of the full city model") + 1 :]
    assert total[:5] == ["77", "99", "2.500", "-", "0.875"]
    assert "h1-part2 at 12.5, 7.0: few & far" in words
