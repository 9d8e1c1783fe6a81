"""Checksums (CRC-32): of files that a stage states, and of texts, results and manifests, which carry their own."""

import re
from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, cast

from deflate import crc32

from tiler.objects.places import in_bucket
from tiler.store.remembered import remember

FILES = "files"  # the fact of a result that states files beside the store
GONE = "is not there"
CHANGED = "its checksum differs"
BLANK = b'"checksum": "00000000"'  # what a text has in the place of its checksum until it is sealed
TAIL = 8  # hexadecimal digits at the end of a sealed file
READ_BYTES = 1 << 20
SMALL_OBJECT = 1 << 18  # bytes of an object that one request reads whole
_SEAL = re.compile(rb'"checksum": "[0-9a-f]{8}"')


def open_binary(path: Path) -> BinaryIO:
    """Open a file for reading; a small object is read in one request."""
    if in_bucket(path):
        data = path.read_bytes(SMALL_OBJECT)
        if len(data) < SMALL_OBJECT:
            return BytesIO(data)
    return cast(BinaryIO, path.open("rb"))


def sum_file(path: Path) -> tuple[int, int]:
    """Give the size (bytes) and the CRC-32 of a file; OSError if it cannot be read."""
    with open_binary(path) as file:
        return _sum_bytes(file)


def seal(text: bytes) -> bytes:
    """Write the checksum of a text into its first `BLANK`; ValueError without one.

    Examples
    --------
    >>> seal(b'{"checksum": "00000000", "n": 3}')
    b'{"checksum": "0e69e4e6", "n": 3}'
    """
    if BLANK not in text:
        raise ValueError(f"the text has no {BLANK.decode()}")
    return text.replace(BLANK, f'"checksum": "{crc32(text):08x}"'.encode(), 1)


def is_sealed(text: bytes) -> bool:
    """Return whether a text is as `seal` has left it; one without a checksum is not.

    Examples
    --------
    >>> is_sealed(seal(b'{"checksum": "00000000", "n": 3}')), is_sealed(b'{"checksum": "00000000", "n": 3}')
    (True, False)
    """
    found = _SEAL.search(text)
    return found is not None and seal(text[: found.start()] + BLANK + text[found.end() :]) == text


def seal_file(path: Path) -> None:
    """Write the CRC-32 of a file without its last `TAIL` bytes into these bytes."""
    with path.open("r+b") as file:
        size = file.seek(0, 2) - TAIL
        file.seek(0)
        _, crc = _sum_bytes(file, size)
        file.seek(size)
        file.write(f"{crc:08x}".encode())


def find_file_damage(path: Path) -> str:
    """Describe what is wrong with a file that `seal_file` has left; nothing if every byte is as it was."""
    return remember(path, ("damage",), lambda: _find_file_damage(path), kept=_is_sound)


def _find_file_damage(path: Path) -> str:
    try:
        with open_binary(path) as file:
            size = file.seek(0, 2) - TAIL
            file.seek(0)
            found, crc = _sum_bytes(file, max(size, 0))
            return "" if found == size and file.read() == f"{crc:08x}".encode() else CHANGED
    except (FileNotFoundError, NotADirectoryError):
        return GONE
    except OSError as error:
        return f"cannot be read ({error.strerror})"


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
    """Describe what is wrong with stated files, by their path below a folder; every byte is read.

    Examples
    --------
    >>> find_changed_files(Path("/"), {"no/such": [3, 0]})
    {'no/such': 'is not there'}
    """
    found = {path: find_change(folder / path, stated) for path, stated in sorted(files.items())}
    return {path: change for path, change in found.items() if change}


def find_change(path: Path, stated: Any) -> str:
    """Describe how a file differs from its stated size and CRC-32, nothing if it does not."""
    if not _is_statement(stated):
        return "no size and checksum of it are stated"
    return remember(path, ("change", *stated), lambda: _find_change(path, stated), kept=_is_sound)


def _find_change(path: Path, stated: list[int]) -> str:
    try:
        size, crc = sum_file(path)
        if size != stated[0]:
            return f"has {size} bytes instead of {stated[0]}"
        return "" if crc == stated[1] else CHANGED
    except (FileNotFoundError, NotADirectoryError):
        return GONE
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def _is_sound(damage: str) -> bool:
    return not damage


def _is_statement(stated: Any) -> bool:
    return isinstance(stated, list) and [type(number) for number in stated] == [int, int]


def _sum_bytes(file: BinaryIO, at_most: int | None = None) -> tuple[int, int]:
    """Give number and CRC-32 of the bytes that follow in a file, of no more than so many."""
    size = crc = 0
    while block := file.read(READ_BYTES if at_most is None else min(READ_BYTES, at_most - size)):
        size, crc = size + len(block), crc32(block, crc)
    return size, crc
