"""The documentation: no warning, no link that leads nowhere, and a browser shows it without the network."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

import tiler

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "docs" / "site"
PHONE = 390  # pixels
SOME = (
    "index",
    "docs/stages",
    "docs/python",
    "notebooks/first_poisson",
    "reference/python",
    "reference/parameters",
)


class Anchors(HTMLParser):
    """What a page links to, and what it has to link to."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.loads: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Gather links, ids, and what the page loads."""
        given = dict(attrs)
        if name := given.get("id"):
            self.ids.add(name)
        if tag == "a" and (target := given.get("href")):
            self.links.append(target)
        if tag == "link" and (given.get("rel") or "") != "stylesheet":
            return
        if tag in ("link", "script", "img", "iframe") and (source := given.get("href") or given.get("src")):
            self.loads.append(source)


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def build(out: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SITE / "build.py"), str(out)]
    return subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build all pages."""
    out = tmp_path_factory.mktemp("docs")
    done = build(out)
    assert (done.returncode, done.stderr) == (0, "")
    return out / "html"


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, Anchors]:
    """All pages, by their path."""
    found = {}
    for path in sorted(site.rglob("*.html")):
        parser = Anchors()
        parser.feed(path.read_text())
        found[path.relative_to(site).as_posix()] = parser
    return found


def broken_links(site: Path, pages: dict[str, Anchors]) -> Iterator[str]:
    for name, page in pages.items():
        for link in page.links + page.loads:
            if urlsplit(link).scheme:
                continue
            target, anchor = urlsplit(link).path, urlsplit(link).fragment
            there = ((site / name).parent / unquote(target)).resolve() if target else (site / name).resolve()
            if not there.is_file():
                yield f"{name}: {link}"
            elif anchor and there.suffix == ".html":
                known = pages[there.relative_to(site.resolve()).as_posix()].ids
                if unquote(anchor) not in known:
                    yield f"{name}: {link}"


@pytest.mark.long
@pytest.mark.timeout(1500)
def test_pages_link_to_what_is_there_and_load_nothing_from_outside(site: Path, pages: dict[str, Anchors]) -> None:
    assert {f"{name}.html" for name in SOME} <= pages.keys()
    guides = {path.stem for path in (ROOT / "docs").glob("*.md")}
    assert guides == {Path(name).stem for name in pages if name.startswith("docs/")}
    modules = sum(name.startswith("reference/modules/tiler.") for name in pages)
    assert modules >= len([*(ROOT / "tiler").rglob("*.py")]) - 1
    assert sum(len(page.links) for page in pages.values()) > 5000
    assert list(broken_links(site, pages)) == []
    assert [load for page in pages.values() for load in page.loads if urlsplit(load).netloc] == []


@pytest.mark.long
@pytest.mark.timeout(1500)
def test_the_reference_has_the_docstrings(site: Path, pages: dict[str, Anchors]) -> None:
    assert {f"tiler.{name}" for name in tiler.__all__} <= pages["reference/python.html"].ids
    assert (
        "pipeline.columns.trim_layers.first_levels"
        in pages["reference/modules/pipeline.columns.trim_layers.html"].ids
    )
    parameters = (site / "reference" / "parameters.html").read_text()
    assert "mesh_size" in parameters
    assert "target edge length h" in parameters
    assert "citystitch plan" in (site / "reference" / "commands.html").read_text()


@pytest.mark.long
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("width", [PHONE, 1280])
def test_a_browser_shows_the_pages(site: Path, tmp_path: Path, width: int) -> None:
    for found in open_pages([site / f"{name}.html" for name in SOME], width, tmp_path):
        assert found["said"] == [], found["url"]
        assert found["failed"] == []
        assert all(url.startswith(("file:", "data:")) for url in found["fetched"]), found["url"]
        assert "citystitch" in found["title"]
        assert found["width"] <= width, found["url"]
        if "first_poisson" in found["url"]:
            assert found["formulas"] == 1


def open_pages(paths: list[Path], width: int, folder: Path) -> list[dict[str, Any]]:
    """Open pages in headless Chromium."""
    asked = folder / "asked.json"
    asked.write_text(json.dumps({"width": width, "urls": [path.as_uri() for path in paths]}))
    modules = subprocess.run(["npm", "root", "-g"], capture_output=True, text=True, check=True).stdout.strip()
    command = ["node", str(ROOT / "tests" / "helpers" / "open_pages.mjs"), str(asked)]
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, "NODE_PATH": modules}, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_broken_link_or_name_ends_the_build(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    (source / "index.md").write_text("# A page\n\nSee [elsewhere](nowhere.md).\n\n```{toctree}\nnames\n```\n")
    (source / "names.rst").write_text(
        "Names\n=====\n\nSee `tiler.workflow.run.run` and `tiler.workflow.run.walk`.\n"
    )
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-c", str(SITE), str(source)]
    done = subprocess.run(
        [*command, str(tmp_path / "html")], capture_output=True, text=True, env=environment(), check=False
    )
    assert done.returncode == 1
    assert re.search(r"index\.md.*nowhere\.md", done.stderr)
    assert "there is no tiler.workflow.run.walk" in done.stderr
    assert "tiler.workflow.run.run" not in done.stderr


def test_examples_of_the_build_hold() -> None:
    command = [sys.executable, "-m", "doctest", str(SITE / "known_names.py")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)
    assert (done.returncode, done.stdout) == (0, "")


def test_links_that_leave_the_pages_become_text() -> None:
    """Those to notebooks lead to their pages, those to what is not there stay, to be told by Sphinx."""
    code = (
        f"import sys; sys.path.insert(0, {str(SITE)!r}); from build import ROOT, mend_links; "
        "print(mend_links(sys.argv[1], ROOT / 'docs' / 'x.md'))"
    )
    text = "[a](../LICENSE) [b](../notebooks/x.ipynb) [c](stages.md#keys) [d](../none.txt) [e](../README.md)"
    done = subprocess.run([sys.executable, "-c", code, text], capture_output=True, text=True, check=True)
    expected = "a [b](../notebooks/x.md) [c](stages.md#keys) [d](../none.txt) [e](../index.md)\n"
    assert done.stdout == expected
