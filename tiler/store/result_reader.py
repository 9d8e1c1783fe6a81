"""One result of the store read back and verified: see `tiler.store.store` for what it is made of."""

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError, OutputError
from tiler.store.checksums import is_sealed
from tiler.store.packing import Table, check_entry, checksums, count_columns, verified_chunks
from tiler.store.zarr_files import GROUP, ChunkForm

PACKED = "_packed"
RESERVED = ("arrays", "checksum", "digest", "files")


def read_group(folder: Path) -> dict[str, Any]:
    """Read all attributes of a result; ValueError if its file is not as it was written."""
    text = (folder / GROUP).read_bytes()
    if not is_sealed(text):
        raise ValueError("checksum of the attributes differs")
    attributes: dict[str, Any] = json.loads(text)["attributes"]
    return attributes


def open_result(folder: Path, stage: str, name: str) -> tuple[Table, dict[str, Any], str]:
    """Read the table of arrays, the attributes and the digest of a result."""
    with damage(folder, stage, name, "attributes"):
        attributes = read_group(folder)
        table, digest = attributes["arrays"], attributes["digest"]
        return table, {key: value for key, value in attributes.items() if key not in RESERVED}, digest


def find_entry(folder: Path, table: Table, array: str, stage: str, name: str) -> dict[str, Any]:
    """Look an array up: ValueError if there is none of the name, InputError if what is said of it is damaged."""
    if array not in table or array == PACKED:
        names = ", ".join(sorted(set(table) - {PACKED})) or "none"
        raise ValueError(f"stage {stage}, {name}: no array {array}, it has: {names}")
    with damage(folder, stage, name, array):
        check_entry(table[array])
    return table[array]


def read_packed(folder: Path, stage: str, name: str, table: Table) -> NDArray[Any]:
    """Read the bytes that the small arrays of a result lie in; InputError if they are damaged."""
    with damage(folder, stage, name, PACKED):
        entry = table[PACKED]
        if "base64" not in entry:
            check_entry(entry)
    if "base64" in entry:  # under the checksum of the attributes
        return np.frombuffer(base64.b64decode(entry["base64"]), dtype=np.uint8)
    return read_chunks(folder, stage, name, PACKED, entry)


def read_chunks(
    folder: Path,
    stage: str,
    name: str,
    array: str,
    entry: Mapping[str, Any],
    ranges: Sequence[tuple[int, int]] | None = None,
) -> NDArray[Any]:
    """Read rows of one zarr array, all by default, and verify every chunk that was read.

    Ranges ascend. Memory is that of the rows that are wanted, and of one chunk.
    """
    n_rows, chunk = entry["shape"][0], entry["chunk"]
    wanted = [(0, n_rows)] if ranges is None else ranges
    if "columns" in entry:
        columns = (0, entry["shape"][1])
        strips = [read_window(folder, stage, name, array, entry, rows, columns) for rows in wanted]
        return strips[0] if len(strips) == 1 else np.concatenate(strips)
    n_read, held = 0, -1
    with damage(folder, stage, name, array):
        form = ChunkForm.of(entry)
        form.check((folder / array / GROUP).read_bytes())
        rows = np.empty((sum(stop - start for start, stop in wanted), *form.shape[1:]), form.dtype)
        for start, stop in wanted:
            for k in range(start // chunk, -(-stop // chunk)):
                if k != held:
                    block, held = form.read(folder / array, k), k
                    if list(verified_chunks(block, chunk, entry["crc"][k : k + 1])):
                        raise ValueError(f"checksum differs in chunk {k}")
                part = block[max(start - k * chunk, 0) : stop - k * chunk]
                rows[n_read : n_read + len(part)] = part
                n_read += len(part)
    return rows


def read_window(
    folder: Path,
    stage: str,
    name: str,
    array: str,
    entry: Mapping[str, Any],
    rows: tuple[int, int],
    columns: tuple[int, int],
) -> NDArray[Any]:
    """Read a window of a raster that lies in square chunks, and verify every chunk that was read."""
    (top, bottom), (left, right) = rows, columns
    height, width, beside = entry["chunk"], entry["columns"], count_columns(entry)
    with damage(folder, stage, name, array):
        form = ChunkForm.of(entry)
        form.check((folder / array / GROUP).read_bytes())
        found = np.empty((bottom - top, right - left), form.dtype)
        for j in range(top // height, -(-bottom // height)):
            for i in range(left // width, -(-right // width)):
                block = np.ascontiguousarray(form.read(folder / array, j, i))
                if checksums(block, height) != [entry["crc"][j * beside + i]]:
                    raise ValueError(f"checksum differs in chunk {j}/{i}")
                y, x = j * height - top, i * width - left
                inner = block[max(-y, 0) : bottom - top - y, max(-x, 0) : right - left - x]
                y, x = max(y, 0), max(x, 0)
                found[y : y + inner.shape[0], x : x + inner.shape[1]] = inner
    return found


def join_rows(parts: Sequence[NDArray[Any]], like: NDArray[Any]) -> NDArray[Any]:
    """Put rows one after the other in memory of their own, so that no chunk stays with a few of them."""
    if len(parts) == 1 and len(parts[0]) == len(like):
        return parts[0]
    return np.concatenate([like[:0], *parts])


@contextmanager
def damage(folder: Path, stage: str, name: str, array: str) -> Iterator[None]:
    """Whatever zarr and its codecs raise on broken files becomes one error that says where."""
    try:
        yield
    except (MemoryError, OutputError):  # a bucket that does not answer has no damage
        raise
    except Exception as error:
        state = "is damaged" if (folder / GROUP).is_file() else "is not there"
        raise InputError(
            f"stage {stage}, {name}: {array} in {folder} {state} ({error}); run again: it is made anew"
        ) from error
