"""Files that a stage writes beside the store: how its facts state them, and whether they are still there."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

FILES = "files"  # the fact that states them


def file_sizes(folder: Path, paths: Iterable[Path]) -> dict[str, int]:
    """Give the size (bytes) of files by their path below a folder, as the fact `FILES` states it."""
    return {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}


def check_files(stage: str, facts: Mapping[str, Any]) -> None:
    """Raise ValueError unless the fact `FILES`, if there is one, is sizes by path."""
    files = facts.get(FILES, {})
    if not isinstance(files, dict) or not all(type(size) is int for size in files.values()):
        raise ValueError(f"facts of stage {stage}: {FILES!r} states files that were written, sizes by path")


def files_are_there(folder: Path, facts: Mapping[str, Any]) -> bool:
    """Tell whether all files that facts state are below a folder with their sizes.

    Examples
    --------
    >>> files_are_there(Path("/"), {"n": 1}), files_are_there(Path("/"), {"files": {"no/such": 3}})
    (True, False)
    """
    try:
        return all((folder / path).stat().st_size == size for path, size in facts.get(FILES, {}).items())
    except OSError:
        return False
