"""Code in README.md and docs/*.md: commands are taken by the command line and run, imports lead somewhere."""

import ast
import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import pytest

import tiler
from tiler.cli.main import main, make_parser

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FOREIGN = {"dolfinx", "mpi4py"}  # packages of the system's Python
PROGRAM = "citystitch"


def blocks(path: Path, language: str) -> list[str]:
    """Fenced blocks of a page."""
    return re.findall(rf"```{language}\n(.*?)```", path.read_text(), flags=re.DOTALL)


def commands(path: Path) -> list[list[str]]:
    """Arguments of every `citystitch` in the shell blocks of a page."""
    lines = "".join(blocks(path, "sh")).replace("\\\n", " ").splitlines()
    words = [shlex.split(line, comments=True) for line in lines]
    return [line[1:] for line in words if line and Path(line[0]).name == PROGRAM]


def test_every_command_is_taken() -> None:
    found = [(path.name, words) for path in PAGES for words in commands(path)]
    assert len(found) > 15
    for page, words in found:
        try:
            make_parser().parse_args(words)
        except SystemExit:
            pytest.fail(f"{page}: citystitch {shlex.join(words)}")


def test_every_import_leads_somewhere() -> None:
    code = [(path.name, block) for path in PAGES for block in blocks(path, "python")]
    assert len(code) > 8
    for page, block in code:
        nodes = [
            node for node in ast.walk(ast.parse(block, page)) if isinstance(node, (ast.Import, ast.ImportFrom))
        ]
        for node in nodes:
            line = ast.unparse(node)
            if not FOREIGN & set(re.findall(r"\w+", line)):
                exec(line, {})


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the pages name: ``tiles``, ``buildings.gpkg``, and the block of the demo."""
    folder = tmp_path_factory.mktemp("pages")
    files = tiler.write_city(folder / "city", size=300, buildings=12, density=1.0)
    (folder / "tiles").symlink_to(files.clouds[0].parent)
    (folder / "buildings.gpkg").symlink_to(files.footprints)
    (folder / "tiler").symlink_to(ROOT / "tiler")
    (folder / "slurm.toml").symlink_to(ROOT / "deploy" / "slurm" / "slurm.toml")
    return folder


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_commands_of_readme_and_formats_run(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first run is one of four tiles, so that an export in four parts has some for each.

    Those for a scheduler and a bucket have tests of their own, and a job is made but not submitted.
    """
    monkeypatch.chdir(workplace)
    here = [words for words in commands(ROOT / "README.md") if not {"--scheduler", "s3://bucket/run"} & {*words}]
    first, *others = [[*words, "--dry-run"] if words[0] == "submit" else words for words in here]
    assert main([*expand(first), "--tile-size", "150"]) == 0
    city = tiler.open("out")
    assert len(city) == 4
    (block,) = (block for block in blocks(ROOT / "README.md", "python") if "meshio" in block)
    names: dict[str, Any] = {}
    exec(re.sub(r"\d+_\d+", city.tiles[0], block), names)
    assert len(names["mesh"].cells_dict["tetra"]) == len(city.read(city.tiles[0]).cells)
    for words in [*commands(ROOT / "docs" / "formats.md"), *others]:
        assert main([*expand(words), *(["--overwrite"] if words[0] == "export" else [])]) == 0, words
    (block,) = blocks(ROOT / "docs" / "formats.md", "python")
    done = subprocess.run(["/usr/bin/python3", "-c", block], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_code_below_ground_runs(workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workplace)
    page = ROOT / "docs" / "underground.md"
    for words in commands(page):
        assert main(words) == 0, words
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), {})


def expand(words: list[str]) -> list[str]:
    """Do what the shell does with a pattern."""
    return [name for word in words for name in (sorted(map(str, Path().glob(word))) if "*" in word else [word])]
