"""What a finished run has made (its manifest), and `citystitch check --store`, which compares all of it."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from pipeline.data.errors import CityError, InputError
from tiler.engine.records import Records
from tiler.engine.task import APART
from tiler.store.atomic import replacing
from tiler.store.checksums import FILES, GONE, TAIL, find_change, find_file_damage, is_sealed, seal_file
from tiler.store.edit_journal import JOURNAL, read_journal
from tiler.store.folder_lock import is_held
from tiler.store.kept import WHOLE, is_kept
from tiler.store.out_folder import INDEXES, MANIFEST_PATH, PIECES, RUN_RECORD, STORE
from tiler.store.store import SUFFIX, Store

STRAY = "is not of this run"


@dataclass(frozen=True)
class Entry:
    """A result as the manifest states it: stage and name, key and digest, and its files beside the store.

    Of these, size (bytes) and CRC-32 by path below the run's folder.
    """

    stage: str
    name: str
    key: str
    digest: str
    files: Mapping[str, Any]


def write_manifest(path: Path, records: Records, files: Mapping[str, Any], keep: str = WHOLE) -> None:
    """Write the manifest: a line of JSON a result that is kept, by stage and name, at last the files of none.

    These are as `tiler.store.checksums.state_files` gives them. No clock and no place is in the manifest: the same
    input gives the same bytes. It appears whole or not at all, and ends as `seal_file` leaves it.
    """
    with replacing(path, durable=True) as part:
        with part.open("wb") as file:
            for stage, name in sorted(item for item in records if is_kept(item[0], keep)):
                key, _ = records.made(stage, name)
                entry = [stage, name, key, records.digest(stage, name), records.files(stage, name)]
                file.write(json.dumps(entry, sort_keys=True).encode() + b"\n")
            file.write(json.dumps({FILES: files}).encode() + b"\n" + b"0" * TAIL)
        seal_file(part)


def read_manifest(path: Path) -> Iterator[Entry | Mapping[str, Any]]:
    """Read a manifest line by line: entries, at last the files that no result states.

    InputError if it is not there or damaged, before the first entry.
    """
    if damage := find_file_damage(path):
        raise InputError(f"{path}: {damage}; run again")
    try:
        with path.open("rb") as file:
            for content in map(json.loads, file):
                if isinstance(content, dict):
                    yield content[FILES]
                    return
                yield Entry(*content)
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run again") from None


def find_remade(path: Path, records: Records) -> dict[tuple[str, str], str]:
    """Find the results of a finished run that the next one computed again with the same key, and say why.

    Without a manifest only those that were there and damaged.
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


@dataclass(frozen=True)
class Damage:
    """A damaged artefact: its path below the run's folder, and what is wrong with it."""

    path: str
    what: str

    def __str__(self) -> str:
        """Give it as a line of text."""
        return f"{self.path}: {self.what}"


class Audit:
    """The audit of a run folder: iterate over it once, for one damage after the other.

    Parameters
    ----------
    directory : Path
        The folder of a run; no run should be at work there.
    deep : bool
        Decompress every chunk and compute the digest of every result anew, beside the checksums of the files.

    Attributes
    ----------
    finished : bool
        Whether the run was finished, so that what is missing is known.
    n_results, n_files, n_bytes : int
        Results and files beside the store that were read, and the size of all of them.

    Raises
    ------
    InputError
        If the folder is not that of a run.
    """

    def __init__(self, directory: Path, *, deep: bool = True) -> None:
        if not any((directory / name).exists() for name in (RUN_RECORD, STORE)):
            raise InputError(f"{directory}: holds neither {RUN_RECORD} nor {STORE}; give the folder of a run")
        self.directory, self.deep = directory, deep
        self.finished = False
        self.n_results = self.n_files = self.n_bytes = 0
        self._store = Store(directory / STORE)
        self._manifest = directory / MANIFEST_PATH
        self._is_listed = False  # what there must be is known

    def __iter__(self) -> Iterator[Damage]:
        yield from self.check_top()
        yield from self.check_results()

    def check_top(self) -> Iterator[Damage]:
        """Check the record, the manifest, and the files that the manifest alone states."""
        record, change = read_sealed_record(self.directory / RUN_RECORD)
        if change:
            yield Damage(RUN_RECORD, change)
        self.finished = record.get("status") == "done" if not change else self._manifest.exists()
        yield from self._check_journal(record.get("edits", []) if self.finished and not change else None)
        if not self.finished:
            return
        try:
            (last,) = (line for line in read_manifest(self._manifest) if not isinstance(line, Entry))
            self._is_listed = True
            yield from self._check_files(last)
        except InputError as error:
            yield Damage(MANIFEST_PATH, _reason(error, self._manifest) if self._manifest.exists() else GONE)
            for name in INDEXES:
                if not (self.directory / name).exists():
                    yield Damage(name, GONE)

    def _check_journal(self, made_of: list[int] | None) -> Iterator[Damage]:
        """Check that every edit is as it was written, and that the mesh is made of all of them and no others."""
        try:
            numbers = [edit.number for edit in read_journal(self.directory)]
        except InputError as error:
            yield Damage(JOURNAL, str(error))
            return
        if made_of is not None and made_of != numbers:
            yield Damage(JOURNAL, f"has the edits {numbers}, the mesh is of {made_of}")

    def check_results(self) -> Iterator[Damage]:
        """Check all results and their files, and look for what is neither; after `check_top`."""
        stages: set[str] = set()
        files: set[str] = set()
        for stage, group in groupby(self._entries(), lambda entry: entry.stage):
            stages.add(stage)
            names: set[str] = set()
            for entry in group:
                names.add(entry.name)
                files.update(entry.files)
                yield from self._check_result(entry)
                yield from self._check_files(entry.files)
            for name in self._store.names(stage):
                if name not in names:
                    yield Damage(f"{STORE}/{stage}/{name}{SUFFIX}", STRAY)
        for stage in self._store.stages():
            if stage not in stages:
                yield Damage(f"{STORE}/{stage}", STRAY)
        for path in self._store.find_strays():
            if path.parent.name not in stages and path.parent != self._store.path:
                continue  # in a stage that was named
            yield Damage(path.relative_to(self.directory).as_posix(), STRAY)
        if self._is_listed:
            for folder, suffix in PIECES.items():
                for path in sorted((self.directory / folder).glob(f"*{suffix}")):
                    name = path.relative_to(self.directory).as_posix()
                    if name not in files:
                        yield Damage(name, STRAY)

    def _entries(self) -> Iterator[Entry]:
        """List the results as the manifest does; without one, those that are there, with what they state."""
        if self._is_listed:
            yield from (line for line in read_manifest(self._manifest) if isinstance(line, Entry))
            return
        for stage in self._store.stages():
            for name in self._store.names(stage):
                yield self._entry(stage, name)

    def _entry(self, stage: str, name: str) -> Entry:
        try:
            attributes, digest = self._store.describe(stage, name)
            return Entry(stage, name, attributes["key"], digest, attributes["facts"].get(FILES, {}))
        except (CityError, KeyError, ValueError):
            return Entry(stage, name, "", "", {})

    def _check_result(self, entry: Entry) -> Iterator[Damage]:
        """Check the bytes of a result, then what the manifest and its own digest say of it."""
        self.n_results += 1
        place = f"{STORE}/{entry.stage}/{entry.name}{SUFFIX}"
        damage = self._store.find_damage(entry.stage, entry.name)
        if damage != GONE:
            self.n_bytes += self._store.file(entry.stage, entry.name).stat().st_size
        if damage:
            yield Damage(place, damage)
            return
        try:
            attributes, digest = self._store.describe(entry.stage, entry.name)
            if (attributes.get("key"), digest) != (entry.key, entry.digest):
                yield Damage(place, "has another key or digest than the run that was finished")
            elif self.deep:
                computed = self._store.compute_digest(entry.stage, entry.name, apart=APART)
                if computed != digest:
                    yield Damage(place, f"its content has the digest {computed}, stated is {digest}")
        except InputError as error:
            yield Damage(place, _reason(error, self._store.file(entry.stage, entry.name)))

    def _check_files(self, files: Mapping[str, Any]) -> Iterator[Damage]:
        for path, stated in sorted(files.items()):
            self.n_files += 1
            change = find_change(self.directory / path, stated)
            if change:
                yield Damage(path, change)
            if change != GONE:
                self.n_bytes += (self.directory / path).stat().st_size


def read_sealed_record(path: Path) -> tuple[dict[str, Any], str]:
    """Read ``run.json``, empty if it is no JSON object, and say what is wrong with it: nothing if it is sound."""
    try:
        text = path.read_bytes()
        record = json.loads(text)
    except FileNotFoundError:
        return {}, GONE
    except OSError as error:
        return {}, f"cannot be read ({error.strerror})"
    except (ValueError, RecursionError) as error:
        return {}, f"is no JSON ({error})"
    if not isinstance(record, dict):
        return {}, "is no JSON object"
    return record, "" if is_sealed(text) else "its checksum differs"


def audit_run(directory: Path, tell: Callable[[str], None]) -> bool:
    """Audit a run folder: call `tell` with a line for each damaged artefact, and with one at the end.

    Returns
    -------
    bool
        Whether all is as it was written.

    Raises
    ------
    InputError
        If the folder is not that of a run, or a run is at work there.
    """
    if is_held(directory):
        raise InputError(f"{directory}: a run is at work there; wait for its end")
    audit, n_damaged = Audit(directory), 0
    for damage in audit:
        n_damaged += 1
        tell(f"DAMAGED {damage}")
    seen = f"{audit.n_results} results and {audit.n_files} files beside the store, {audit.n_bytes / 1e6:.1f} MB"
    if not audit.finished:
        seen += ", of a run that is not finished: what is missing is not known"
    verdict = "every byte is as it was written"
    if n_damaged:
        verdict = f"{n_damaged} damaged; give the command of the run again: it makes these anew, and no more"
    tell(f"{directory}: {seen}: {verdict}")
    return not n_damaged


def _reason(error: InputError, path: Path) -> str:
    """Take place and next move out of the message of a reader: the audit prints both itself."""
    text = str(error).removeprefix(f"{path}: ")
    return text.rsplit("; ", 1)[0]
