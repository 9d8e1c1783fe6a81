"""The store: results by stage and name in zarr (v3), written whole or not at all, verified on every read.

A result is a zarr group ``<stage>/<name>``. Arrays above 128 kB are arrays of their own; smaller ones lie in one
array of bytes, ``_packed``, and if all of them are less than 16 kB, in the group's attributes. These hold what the
writer gave, ``arrays`` (type and shape of each array and the CRC-32 of the raw bytes of each chunk), ``digest``, a
hash of the content, ``files``, size and CRC-32 of every file of the arrays as it lies on disk, and ``checksum``,
the CRC-32 of the file that the attributes are in. In a bucket each file is an object, and that of the attributes
is put last (`tiler.objects.results`).
"""

import os
import uuid
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from blake3 import blake3
from numpy.typing import ArrayLike, NDArray

from pipeline.errors import OutputError
from tiler.objects.places import in_bucket
from tiler.store.packing import raw_bytes, unpack
from tiler.store.result_reader import (
    PACKED,
    damage,
    find_entry,
    join_rows,
    open_result,
    read_chunks,
    read_group,
    read_packed,
    read_window,
)
from tiler.store.result_writer import DIGEST_BYTES, PARTIAL, Writer, delete, hash_content, withdraw
from tiler.store.stated_files import GONE, find_changed_files
from tiler.store.zarr_files import GROUP

MANIFEST = "manifest.jsonl"  # the only file beside the stages, see `tiler.store.manifest`


class Store:
    """Results by stage and name below one folder.

    Parameters
    ----------
    path : Path
        Folder of the store; made when first written to.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def folder(self, stage: str, name: str) -> Path:
        """Say where a result lies; ValueError for a name that is no plain folder name."""
        for part in (stage, name):
            if not part or part[0] == "." or any(sign in part for sign in "/\\\0"):
                raise ValueError(f"{part!r} cannot name a folder of the store")
        return self.path / stage / name

    def writer(self, stage: str, name: str) -> "Writer":
        """Begin a result: a context manager with ``put``, ``append`` and ``commit``."""
        return Writer(self.folder(stage, name))

    def write(self, stage: str, name: str, arrays: Mapping[str, ArrayLike], **attributes: Any) -> None:
        """Write one result; it becomes visible at once and whole."""
        with self.writer(stage, name) as writer:
            writer.put(**arrays)
            writer.commit(attributes)

    def read(
        self, stage: str, name: str, *, names: Collection[str] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Read one result: its arrays and its attributes.

        Parameters
        ----------
        stage, name : str
            Which result.
        names : collection of str, optional
            Arrays to read; all by default, none for an empty collection.

        Raises
        ------
        InputError
            If it is not there or damaged; the message names stage, name and array.
        ValueError
            If it has no array of such a name.
        """
        folder = self.folder(stage, name)
        table, attributes, _ = open_result(folder, stage, name)
        wanted = sorted(set(names)) if names is not None else sorted(set(table) - {PACKED})
        entries = {array: find_entry(folder, table, array, stage, name) for array in wanted}
        packed = None
        if any("offset" in entry for entry in entries.values()):
            packed = read_packed(folder, stage, name, table)
        arrays: dict[str, NDArray[Any]] = {}
        for array, entry in entries.items():
            if packed is not None and "offset" in entry:
                with damage(folder, stage, name, array):
                    arrays[array] = unpack(packed, entry)
            else:
                arrays[array] = read_chunks(folder, stage, name, array, entry)
        return arrays, attributes

    def read_rows(self, stage: str, name: str, array: str, start: int, stop: int) -> NDArray[Any]:
        """Read some rows of one array; only the chunks that hold them are decompressed and verified.

        Raises
        ------
        InputError
            If the result is not there, or a chunk that is needed is damaged.
        ValueError
            If there is no such array, or not ``0 <= start <= stop <= n_rows``.
        """
        return self.read_ranges(stage, name, [array], [(start, stop)])[array]

    def read_ranges(
        self, stage: str, name: str, names: Collection[str], ranges: Sequence[tuple[int, int]]
    ) -> dict[str, NDArray[Any]]:
        """Read ranges of rows of some arrays, put one after the other; errors as for `read_rows`.

        Parameters
        ----------
        stage, name : str
            Which result.
        names : collection of str
            Arrays to read.
        ranges : sequence of (start, stop)
            Rows, ascending and apart from each other. A chunk that holds rows of several of them is read once.
        """
        folder = self.folder(stage, name)
        table, _, _ = open_result(folder, stage, name)
        found = {}
        for array in sorted(set(names)):
            entry = find_entry(folder, table, array, stage, name)
            n_rows = entry["shape"][0] if entry["shape"] else 0
            for start, stop in ranges:
                if not 0 <= start <= stop <= n_rows:
                    raise ValueError(
                        f"stage {stage}, {name}: rows {start} to {stop} of {array}, which has {n_rows}"
                    )
            if "offset" in entry:
                packed = read_packed(folder, stage, name, table)
                with damage(folder, stage, name, array):
                    rows = unpack(packed, entry)
                found[array] = join_rows([rows[start:stop] for start, stop in ranges], rows)
            else:
                found[array] = read_chunks(folder, stage, name, array, entry, ranges)
        return found

    def read_window(
        self, stage: str, name: str, array: str, rows: tuple[int, int], columns: tuple[int, int]
    ) -> NDArray[Any]:
        """Read a window of an array of rows and columns; only chunks that hold some of it are read and verified.

        These are small if it was written by `Writer.put_rasters`.

        Raises
        ------
        InputError
            If the result is not there, or a chunk that is needed is damaged.
        ValueError
            If there is no such array, or it does not hold the window.
        """
        folder = self.folder(stage, name)
        table, _, _ = open_result(folder, stage, name)
        entry = find_entry(folder, table, array, stage, name)
        shape = entry["shape"]
        if len(shape) != 2:
            raise ValueError(f"stage {stage}, {name}: {array} is no raster but {shape}")
        if not (0 <= rows[0] <= rows[1] <= shape[0] and 0 <= columns[0] <= columns[1] <= shape[1]):
            raise ValueError(
                f"stage {stage}, {name}: rows {rows}, columns {columns} of {array}, which has {shape}"
            )
        if "columns" in entry:
            return read_window(folder, stage, name, array, entry, rows, columns)
        return self.read_ranges(stage, name, [array], [rows])[array][:, slice(*columns)]

    def attributes(self, stage: str, name: str) -> dict[str, Any]:
        """Read the attributes of a result and no array; InputError as for `read`."""
        return open_result(self.folder(stage, name), stage, name)[1]

    def describe(self, stage: str, name: str) -> tuple[dict[str, Any], str]:
        """Read the attributes of a result and the digest of its content; InputError as for `read`."""
        _, attributes, digest = open_result(self.folder(stage, name), stage, name)
        return attributes, digest

    def shapes(self, stage: str, name: str) -> dict[str, tuple[int, ...]]:
        """Tell the shape of every array of a result without reading any; InputError as for `read`."""
        table, _, _ = open_result(self.folder(stage, name), stage, name)
        return {array: tuple(entry["shape"]) for array, entry in sorted(table.items()) if array != PACKED}

    def has(self, stage: str, name: str) -> bool:
        """Whether there is a committed result; its arrays are not looked at."""
        return (self.folder(stage, name) / GROUP).is_file()

    def names(self, stage: str) -> list[str]:
        """List the names that have a result of the stage, sorted."""
        folder = self.path / stage
        return sorted(entry.name for entry in folder.iterdir() if entry.name[0] != ".") if folder.is_dir() else []

    def stages(self) -> list[str]:
        """List the stages that have a folder, sorted."""
        return sorted(entry.name for entry in self.path.iterdir() if entry.is_dir()) if self.path.is_dir() else []

    def remove(self, stage: str, name: str | None = None) -> None:
        """Remove a result, or all of a stage; it is gone at once and whole. Nothing happens if it is not there."""
        folder = self.path / stage if name is None else self.folder(stage, name)
        if in_bucket(folder):
            withdraw(folder)
            return
        gone = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}{PARTIAL}")
        try:
            os.replace(folder, gone)
        except FileNotFoundError:
            return
        except OSError as error:
            raise OutputError(f"{folder}: cannot be removed ({error}); check its permissions") from error
        delete(gone)

    def sweep(self, stage: str) -> None:
        """Remove what killed writers of the stage left behind; no writer may be at work.

        In a bucket that lies where the result will be, and goes when it is put or pruned.
        """
        if in_bucket(self.path):
            return
        for folder in (self.path / stage).glob(f".*{PARTIAL}"):
            delete(folder)

    def find_strays(self) -> list[Path]:
        """List what no writer of results has made: hidden entries of stages, and files beside these."""
        if not self.path.is_dir():
            return []
        beside = [entry for entry in self.path.iterdir() if not entry.is_dir() and entry.name != MANIFEST]
        if in_bucket(self.path):  # nothing is hidden there
            return sorted(beside)
        return sorted(beside + [entry for stage in self.stages() for entry in (self.path / stage).glob(".*")])

    def remove_strays(self) -> None:
        """Remove what `find_strays` lists; no writer may be at work."""
        for path in self.find_strays():
            delete(path)

    def find_damage(self, stage: str, name: str) -> dict[str, str]:
        """Hold every file of a result against its checksum.

        Returns
        -------
        dict of str to str
            What is wrong, by path below the result's folder; empty for a sound result.

        Notes
        -----
        Bytes are read as they lie on disk, a megabyte at a time; nothing is decompressed. Strange files are named
        too.
        """
        folder = self.folder(stage, name)
        try:
            files = read_group(folder)["files"]
        except FileNotFoundError:
            return {GROUP: GONE}
        except (OSError, ValueError, KeyError, TypeError) as error:
            return {GROUP: f"is damaged ({error})"}
        found = find_changed_files(folder, files)
        there = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
        return found | dict.fromkeys(sorted(there - {GROUP, *files}), "is not of this result")

    def compute_digest(self, stage: str, name: str, *, apart: Collection[str] = ()) -> str:
        """Compute the digest of a result anew from all that is stored, a chunk at a time.

        Parameters
        ----------
        stage, name : str
            Which result.
        apart : collection of str
            Attributes that do not count, as for `Writer.commit`.

        Raises
        ------
        InputError
            If it is not there or damaged.
        """
        folder = self.folder(stage, name)
        table, attributes, _ = open_result(folder, stage, name)
        packed = read_packed(folder, stage, name, table) if PACKED in table else np.empty(0, np.uint8)
        arrays = []
        for array in sorted(set(table) - {PACKED}):
            entry = find_entry(folder, table, array, stage, name)
            found = blake3()
            if "offset" in entry:
                found.update(raw_bytes(unpack(packed, entry)).data)
            else:
                for start in range(0, entry["shape"][0], entry["chunk"]):
                    stop = min(start + entry["chunk"], entry["shape"][0])
                    rows = read_chunks(folder, stage, name, array, entry, [(start, stop)])
                    found.update(raw_bytes(rows).data)
            arrays.append([array, entry["dtype"], entry["shape"], found.hexdigest(DIGEST_BYTES)])
        return hash_content(arrays, {key: value for key, value in attributes.items() if key not in apart})
