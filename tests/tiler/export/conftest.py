"""Files that several tests read, exported once."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from tiler.cli.main import main
from tiler.export.export import load_format

Exported = Callable[..., Path]


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """Export a run by its folder, a format and words of the command line; what is there is given again."""

    @cache
    def export(run: Path, name: str, *words: str) -> Path:
        kind = load_format(name)
        path = tmp_path_factory.mktemp(name) / f"city{kind.suffix or ('' if kind.folder else f'.{name}')}"
        assert main(["export", str(run), "--format", name, "-o", str(path), *words]) == 0
        return path

    return export
