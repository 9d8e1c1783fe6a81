"""Checksums of files: of any file, and of a JSON text that carries its own."""

import re
from pathlib import Path

from deflate import crc32

from tiler.objects.places import in_bucket

BLANK = '"checksum": "00000000"'  # what a text has in the place of its checksum until it is sealed
READ_BYTES = 1 << 20
_SEAL = re.compile(rb'"checksum": "([0-9a-f]{8})"')


def sum_file(path: Path) -> tuple[int, int]:
    """Give the size (bytes) and the CRC-32 of a file; OSError if it cannot be read."""
    if in_bucket(path):  # in one request where it is small
        data = path.read_bytes(READ_BYTES)
        if len(data) < READ_BYTES:
            return len(data), crc32(data)
    size = crc = 0
    with path.open("rb") as file:
        while block := file.read(READ_BYTES):
            size, crc = size + len(block), crc32(block, crc)
    return size, crc


def seal(text: bytes, before: int = 0) -> bytes:
    """Write the checksum of a text into its first `BLANK`.

    Parameters
    ----------
    text : bytes
        Text with `BLANK` in it; ValueError without.
    before : int
        CRC-32 of what comes before the text in its file.

    Examples
    --------
    >>> seal(b'{"checksum": "00000000", "n": 3}')
    b'{"checksum": "0e69e4e6", "n": 3}'
    """
    if BLANK.encode() not in text:
        raise ValueError(f"the text has no {BLANK}")
    found = f'"checksum": "{crc32(text, before):08x}"'
    return text.replace(BLANK.encode(), found.encode(), 1)


def is_sealed(text: bytes, before: int = 0) -> bool:
    """Tell whether a text is as `seal` has left it; one without a checksum is not.

    Examples
    --------
    >>> is_sealed(seal(b'{"checksum": "00000000", "n": 3}')), is_sealed(b'{"checksum": "00000000", "n": 3}')
    (True, False)
    """
    found = _SEAL.search(text)
    if found is None:
        return False
    blank = text[: found.start()] + BLANK.encode() + text[found.end() :]
    return crc32(blank, before) == int(found[1], 16)
