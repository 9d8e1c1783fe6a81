"""Build the documentation: `make docs`, or python docs/site/build.py FOLDER. Pages are in FOLDER/html.

The pages lie as in the repository, so that their links are the same in both: README.md is the front page, docs/
has the guides, notebooks/ the notebooks; reference/ is made of the code. A link to a page that is not there, and
any other warning, ends the build with 1.
"""

import re
import shutil
import sys
from pathlib import Path

from pages import (
    PACKAGES,
    convert_notebook,
    describe_commands,
    describe_interface,
    describe_modules,
    describe_parameters,
)
from sphinx.cmd.build import build_main

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
# In this order; the other guides follow by name.
FIRST_GUIDES = ("python", "stages", "formats", "plan", "meshing", "grading", "underground", "solids", "wind")
LAST_GUIDES = ("architecture", "reliability", "quality", "tiles", "benchmarks")
FIRST_NOTEBOOKS = ("first_mesh", "own_data", "own_stage", "cluster", "seams")
LINK = re.compile(r"(?<!!)\[([^]]*)]\(([^)#:\s]+)(#[^)\s]*)?\)")


def build(out: Path) -> int:
    """Gather all pages in ``out/source`` and write ``out/html``; returns 0, or what Sphinx ends with."""
    source, pages = out / "source", out / "html"
    for folder in (source, pages):
        shutil.rmtree(folder, ignore_errors=True)
    gather(source)
    return build_main(["-W", "--keep-going", "-q", "-j", "auto", "-c", str(HERE), str(source), str(pages)])


def gather(source: Path) -> None:
    """Lay out the sources of all pages."""
    for folder in ("docs", "notebooks", "reference"):
        (source / folder).mkdir(parents=True)
    for path in [*(ROOT / "docs").glob("*.md"), ROOT / "CHANGELOG.md"]:
        place = source / path.relative_to(ROOT)
        place.write_text(mend_links(path.read_text(), path))
    for path in (ROOT / "docs").glob("*.png"):
        shutil.copy(path, source / "docs")
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        (source / "notebooks" / f"{path.stem}.md").write_text(mend_links(convert_notebook(path), path))
    reference = source / "reference"
    (reference / "parameters.md").write_text(describe_parameters())
    (reference / "commands.md").write_text(describe_commands())
    (reference / "python.rst").write_text(describe_interface())
    describe_modules(reference / "modules")
    readme = ROOT / "README.md"
    (source / "index.md").write_text(mend_links(readme.read_text(), readme) + _contents(source))


def mend_links(text: str, path: Path) -> str:
    """Let links to notebooks lead to their pages, and take those away that lead to files which are no pages.

    A link to what the repository does not have is left, so that Sphinx tells it.
    """

    def mend(found: re.Match[str]) -> str:
        words, target, anchor = found[1], found[2], found[3] or ""
        there = (path.parent / target).resolve()
        if there == ROOT / "README.md":
            place = Path("index.md") if path.parent == ROOT else Path("../index.md")
            return f"[{words}]({place}{anchor})"
        if there.suffix == ".ipynb":
            return f"[{words}]({target.removesuffix('.ipynb')}.md{anchor})"
        is_page = there.suffix == ".md" and there.parent in (ROOT, ROOT / "docs")
        is_picture = there.suffix == ".png"
        return found[0] if is_page or is_picture or not there.exists() else words

    return LINK.sub(mend, text)


def _contents(source: Path) -> str:
    guides = _ordered([path.stem for path in (source / "docs").glob("*.md")], FIRST_GUIDES, LAST_GUIDES)
    notebooks = _ordered([path.stem for path in (source / "notebooks").glob("*.md")], FIRST_NOTEBOOKS)
    modules = [f"reference/modules/index-{package}" for package in PACKAGES]
    return "".join(
        _toctree(caption, pages)
        for caption, pages in {
            "Guides": [f"docs/{name}" for name in guides],
            "Notebooks": [f"notebooks/{name}" for name in notebooks],
            "Reference": ["reference/python", "reference/parameters", "reference/commands", *modules],
            "Project": ["CHANGELOG"],
        }.items()
    )


def _ordered(names: list[str], first: tuple[str, ...], last: tuple[str, ...] = ()) -> list[str]:
    middle = sorted(set(names) - {*first, *last})
    return [name for name in (*first, *middle, *last) if name in names]


def _toctree(caption: str, pages: list[str]) -> str:
    return "\n".join(["", "```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```", ""])


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python docs/site/build.py FOLDER")
    sys.exit(build(Path(sys.argv[1]).resolve()))
