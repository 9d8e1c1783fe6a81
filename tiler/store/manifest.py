"""The manifest of a finished run: every result and every file that it has made, with what they must be."""

import json
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import InputError
from tiler.engine.records import Records
from tiler.store.atomic import replacing
from tiler.store.checksums import is_sealed, seal
from tiler.store.stated_files import FILES


@dataclass(frozen=True)
class Entry:
    """A result as the manifest states it.

    Attributes
    ----------
    stage, name : str
        Which result.
    key, digest : str
        As in its `Record`.
    files : mapping
        Size and CRC-32 of the files beside the store that it states, by path below the run's folder.
    """

    stage: str
    name: str
    key: str
    digest: str
    files: Mapping[str, Any]


def write_manifest(path: Path, records: Records, files: Mapping[str, Any]) -> None:
    """Write the manifest: a line of JSON a result, by stage and name, at last the files that none states.

    Parameters
    ----------
    path : Path
        File to write; it appears whole or not at all.
    records : Records
        All results of the run.
    files : mapping
        Size and CRC-32 of further files, as `tiler.store.stated_files.state_files` gives them.

    Notes
    -----
    No clock and no place is in it: the same input gives the same bytes.
    """
    crc = 0
    with replacing(path, durable=True) as part, part.open("wb") as file:
        for stage, name in sorted(records):
            key, _ = records.made(stage, name)
            entry = [stage, name, key, records.digest(stage, name), records.files(stage, name)]
            line = json.dumps(entry, sort_keys=True).encode() + b"\n"
            crc = zlib.crc32(line, crc)
            file.write(line)
        file.write(seal(json.dumps({"checksum": "0" * 8, FILES: files}).encode() + b"\n", crc))


def read_manifest(path: Path) -> Iterator[Entry | Mapping[str, Any]]:
    """Read a manifest line by line: entries, at last the files that no result states.

    Raises
    ------
    InputError
        If it is not there, or its checksum differs. The latter is known after the last entry.
    """
    crc = 0
    try:
        with path.open("rb") as file:
            for line in file:
                content = json.loads(line)
                if isinstance(content, dict):
                    if is_sealed(line, crc) and not file.read(1):
                        yield content[FILES]
                        return
                    break
                yield Entry(*content)
                crc = zlib.crc32(line, crc)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run again") from None
    raise InputError(f"{path}: its checksum differs; run again")


def find_remade(path: Path, records: Records) -> dict[tuple[str, str], str]:
    """Find the results that a finished run had, and that were computed again with the same key all the same.

    Parameters
    ----------
    path : Path
        Manifest of the finished run.
    records : Records
        What came of the next run.

    Returns
    -------
    dict of (stage, name) to str
        What was wrong with each, in the order of names. Without a manifest only those count that were there and
        damaged.
    """
    found = records.damage
    lost: dict[tuple[str, str], str] = {}
    try:
        for entry in read_manifest(path):
            if isinstance(entry, Entry):
                item = entry.stage, entry.name
                if item in records and item not in found and records.made(*item) == (entry.key, True):
                    lost[item] = "was not there"
    except InputError:
        lost = {}
    return dict(sorted((found | lost).items()))
