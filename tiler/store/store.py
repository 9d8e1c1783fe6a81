"""The store: results by stage and name, a file each (`tiler.store.result_file`), whole or not at all."""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from zipfile import ZipFile, ZipInfo

from blake3 import blake3
from numpy.typing import ArrayLike, NDArray

from pipeline.data.errors import OutputError
from tiler.objects.places import remove
from tiler.store.atomic import disk_errors, replacing
from tiler.store.checksums import find_file_damage, seal_file
from tiler.store.remembered import remember
from tiler.store.result_file import GROUP, ResultFile
from tiler.store.result_writer import DIGEST_BYTES, Writer, hash_content, raw_bytes

MANIFEST = "manifest.jsonl"  # the only file beside the stages, see `tiler.workflow.audit`
SUFFIX = ".zip"
PLAIN = re.compile(r"[^./\\\0][^/\\\0]*")  # name of a file that is not hidden
SMALL = 2**18  # bytes of a result that a process which remembers keeps in memory


class Store:
    """Results by stage and name below one folder.

    Parameters
    ----------
    path : Path
        Folder of the store; made when first written to.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def file(self, stage: str, name: str) -> Path:
        """Describe where a result lies; ValueError for a name that is no plain file name."""
        for part in (stage, name):
            if not PLAIN.fullmatch(part):
                raise ValueError(f"{part!r} cannot name a result of the store")
        return self.path / f"{stage}/{name}{SUFFIX}"

    def writer(self, stage: str, name: str) -> Writer:
        """Begin a result: a context manager with ``put``, ``append`` and ``commit``."""
        return Writer(self.file(stage, name))

    def write(self, stage: str, name: str, arrays: Mapping[str, ArrayLike], **attributes: Any) -> None:
        """Write one result; it becomes visible at once and whole."""
        with self.writer(stage, name) as writer:
            writer.put(**arrays)
            writer.commit(attributes)

    def open(self, stage: str, name: str) -> ResultFile:
        """Open a result: a context manager; InputError if it is not there or damaged."""
        return ResultFile(self.file(stage, name), f"stage {stage}, {name}")

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

        def look() -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
            with self.open(stage, name) as result:
                wanted = result.names if names is None else sorted(set(names))
                return {array: result.read(array) for array in wanted}, result.attributes

        what = "read", None if names is None else frozenset(names)
        return remember(self.file(stage, name), what, look, largest=SMALL)

    def read_rows(self, stage: str, name: str, array: str, start: int, stop: int) -> NDArray[Any]:
        """Read some rows of one array; errors as for `read`, ValueError if it does not have them."""
        return self.read_ranges(stage, name, [array], [(start, stop)])[array]

    def read_ranges(
        self, stage: str, name: str, names: Collection[str], ranges: Sequence[tuple[int, int]]
    ) -> dict[str, NDArray[Any]]:
        """Read ranges of rows of some arrays, put one after the other; errors as for `read_rows`.

        Ranges (first, behind the last) are ascending and apart from each other. A chunk that holds rows of several
        is read once, one that holds none is not.
        """
        with self.open(stage, name) as result:
            return {array: result.read(array, ranges) for array in sorted(set(names))}

    def read_window(
        self, stage: str, name: str, array: str, rows: tuple[int, int], columns: tuple[int, int]
    ) -> NDArray[Any]:
        """Read a window of an array of rows and columns; errors as for `read_rows`.

        Only the chunks that hold some of it are read: small ones, if `Writer.put_rasters` wrote it.
        """
        with self.open(stage, name) as result:
            return result.read_window(array, rows, columns)

    def attributes(self, stage: str, name: str) -> dict[str, Any]:
        """Read the attributes of a result and no array; InputError as for `read`."""
        return self.describe(stage, name)[0]

    def describe(self, stage: str, name: str) -> tuple[dict[str, Any], str]:
        """Read the attributes of a result and the digest of its content; InputError as for `read`."""

        def look() -> tuple[dict[str, Any], str]:
            with self.open(stage, name) as result:
                return result.attributes, result.digest

        return remember(self.file(stage, name), ("described",), look)

    def shapes(self, stage: str, name: str) -> dict[str, tuple[int, ...]]:
        """Return the shape of every array of a result; InputError as for `read`."""
        with self.open(stage, name) as result:
            return {array: result.shape(array) for array in result.names}

    def change_key(self, stage: str, name: str, key: str) -> None:
        """Give a result another key, and nothing else: the bytes are those of a result that was made with it."""
        path = self.file(stage, name)
        with disk_errors(path), replacing(path) as part:
            with ZipFile(path) as old, ZipFile(part, "w") as new:
                new.comment = old.comment
                for each in old.namelist():
                    content = old.read(each)
                    if each == GROUP:
                        group = json.loads(content)
                        group["attributes"]["key"] = key
                        content = json.dumps(group).encode()
                    with new.open(ZipInfo(each), "w") as entry:
                        entry.write(content)
            seal_file(part)

    def has(self, stage: str, name: str) -> bool:
        """Whether there is a committed result; its arrays are not looked at."""
        return self.file(stage, name).is_file()

    def names(self, stage: str) -> list[str]:
        """List the names that have a result of the stage, sorted."""
        return sorted(path.name.removesuffix(SUFFIX) for path in self._list(stage) if _is_result(path))

    def stages(self) -> list[str]:
        """List the stages that have a folder, sorted."""
        return sorted(entry.name for entry in self.path.iterdir() if entry.is_dir()) if self.path.is_dir() else []

    def remove(self, stage: str, name: str | None = None) -> None:
        """Remove a result, or all of a stage. Nothing happens if it is not there."""
        path = self.path / stage if name is None else self.file(stage, name)
        try:
            remove(path)
        except FileNotFoundError:
            return
        except OSError as error:
            raise OutputError(f"{path}: cannot be removed ({error}); check its permissions") from error

    def sweep(self, stage: str) -> None:
        """Remove what killed writers of the stage left behind; no writer may be at work."""
        for path in self._list(stage):
            if path.name[0] == ".":
                with suppress(OSError):
                    remove(path)

    def find_strays(self) -> list[Path]:
        """List what is no result: files beside the stages, and other entries of these."""
        if not self.path.is_dir():
            return []
        beside = [entry for entry in self.path.iterdir() if not entry.is_dir() and entry.name != MANIFEST]
        within = [path for stage in self.stages() for path in self._list(stage) if not _is_result(path)]
        return sorted(beside + within)

    def remove_strays(self) -> None:
        """Remove what `find_strays` lists; no writer may be at work."""
        for path in self.find_strays():
            with suppress(OSError):
                remove(path)

    def find_damage(self, stage: str, name: str) -> str:
        """Describe what is wrong with the file of a result; nothing if every byte is as it was written."""
        return find_file_damage(self.file(stage, name))

    def compute_digest(self, stage: str, name: str, *, apart: Collection[str] = ()) -> str:
        """Compute the digest of a result anew, a row of chunks at a time; `apart` as for `Writer.commit`."""
        arrays = []
        with self.open(stage, name) as result:
            for array in result.names:
                found = blake3()
                for rows in result.blocks(array):
                    found.update(raw_bytes(rows).data)
                digest = found.hexdigest(DIGEST_BYTES)
                arrays.append([array, rows.dtype.str, list(result.shape(array)), digest])
            counted = {key: value for key, value in result.attributes.items() if key not in apart}
        return hash_content(arrays, counted)

    def _list(self, stage: str) -> list[Path]:
        folder = self.path / stage
        return list(folder.iterdir()) if folder.is_dir() else []


def _is_result(path: Path) -> bool:
    return path.name[0] != "." and path.name.endswith(SUFFIX) and not path.is_dir()
