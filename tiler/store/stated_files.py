"""Files that a stage writes beside the store: how its facts state them, and whether they are still as stated."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from tiler.objects.places import in_bucket
from tiler.store.checksums import sum_file

FILES = "files"  # the fact that states them
GONE = "is not there"


def state_files(folder: Path, paths: Iterable[Path]) -> dict[str, list[int]]:
    """Give size (bytes) and CRC-32 of files by their path below a folder, as the fact `FILES` states them."""
    return {path.relative_to(folder).as_posix(): list(sum_file(path)) for path in paths}


def check_files(stage: str, facts: Mapping[str, Any]) -> None:
    """Raise ValueError unless the fact `FILES`, if there is one, is what `state_files` gives."""
    files = facts.get(FILES, {})
    if not isinstance(files, dict) or not all(map(_is_statement, files.values())):
        raise ValueError(
            f"facts of stage {stage}: {FILES!r} states files that were written, size and checksum by path"
        )


def find_changed_files(folder: Path, files: Mapping[str, Any]) -> dict[str, str]:
    """Say what is wrong with files, by path; every byte is read.

    Parameters
    ----------
    folder : Path
        Where they are.
    files : mapping
        Size (bytes) and CRC-32 by path, as the fact `FILES`.

    Examples
    --------
    >>> find_changed_files(Path("/"), {"no/such": [3, 0]})
    {'no/such': 'is not there'}
    """
    told = {path: tell_change(folder / path, stated) for path, stated in sorted(files.items())}
    return {path: change for path, change in told.items() if change}


def tell_change(path: Path, stated: Any) -> str:
    """Say how a file differs from its stated size and CRC-32, nothing if it does not."""
    if not _is_statement(stated):
        return "no size and checksum of it are stated"
    try:
        # An object is asked for once; of a file the size is known before it is read.
        remote = in_bucket(path)
        size, crc = sum_file(path) if remote else (path.stat().st_size, None)
        if size != stated[0]:
            return f"has {size} bytes instead of {stated[0]}"
        return "" if (sum_file(path)[1] if crc is None else crc) == stated[1] else "its checksum differs"
    except (FileNotFoundError, NotADirectoryError):
        return GONE
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def _is_statement(stated: Any) -> bool:
    return isinstance(stated, list) and [type(number) for number in stated] == [int, int]
