"""PNG files around pixels that are packed already: Pillow is in an extra, and its bytes follow its version."""

import struct
import zlib
from collections.abc import Sequence

RGB, PALETTE = 2, 3  # types of colour, with 8 bits a value


def frame_png(
    size: tuple[int, int], colour: int, packed: bytes, more: Sequence[tuple[bytes, bytes]] = ()
) -> bytes:
    """Put packed rows of pixels into a PNG file.

    Parameters
    ----------
    size : (int, int)
        Width and height (pixels).
    colour : int
        `RGB` or `PALETTE`.
    packed : bytes
        Rows from the top, each behind the number of its filter, as zlib packs them.
    more : sequence of (bytes, bytes)
        Name and content of chunks that come before, as a palette.

    References
    ----------
    W3C, Portable Network Graphics (PNG) Specification, sections 5 and 11.
    """
    head = struct.pack(">IIBBBBB", *size, 8, colour, 0, 0, 0)
    chunks = ((b"IHDR", head), *more, (b"IDAT", packed), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
