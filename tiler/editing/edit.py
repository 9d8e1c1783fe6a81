"""Edits of the city of a run folder, its journal as a table, and the city of a day."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.data.errors import CityError, ConfigError, InputError, OutputError
from tiler.config.config import Config, make_config
from tiler.config.config_file import with_file
from tiler.editing.requests import (
    Asked,
    describe_uploads,
    edit_buildings,
    make_edit,
    read_buildings,
    read_date,
)
from tiler.editing.staging import begin, commit, finish_interrupted, forget, link_folder
from tiler.editing.uploads import Upload, read_upload
from tiler.engine.executor import Executor
from tiler.engine.schedule import StoppedError
from tiler.mesh_files.run_files import find_files
from tiler.objects.places import refuse_bucket
from tiler.store.atomic import replacing_folder
from tiler.store.edit_journal import Box, Edit, edit_path, read_journal, write_edit
from tiler.store.folder_lock import is_held, only_run
from tiler.store.kept import IN_PIECES, IN_STORE, need
from tiler.store.out_folder import CITY_MODEL, CONFIG, FULL_CITY_MODEL, RUN_RECORD
from tiler.words.plain_text import say_nothing
from tiler.workflow.audit import read_sealed_record
from tiler.workflow.run import run

CITY_FILES = CITY_MODEL, FULL_CITY_MODEL


@dataclass(frozen=True)
class Outcome:
    """An edit that is done."""

    edit: Edit  #: as the journal has it
    record: dict[str, Any]  #: what ``run.json`` holds now
    files: int  #: files of the folder that changed
    #: what to know of its uploads: roof points in the cloud that do not count, a foot off the ground
    told: tuple[str, ...] = ()


@dataclass(frozen=True)
class City:
    """A finished run that can be edited: its folder, its parameters, and CRS and bounds (m) of its region."""

    directory: Path
    config: Config
    crs: str
    bounds: Box


@contextmanager
def held_city(directory: Path, workers: int = 0, say: Callable[[str], None] = say_nothing) -> Iterator[City]:
    """Hold a run folder, so that nobody else edits it; what a killed edit has left is finished or forgotten.

    Raises
    ------
    CityError
        If it holds no finished run, another process has it, or it cannot be edited.
    """
    refuse_bucket(directory, "an edit")
    need(directory, IN_STORE, IN_PIECES)
    with only_run(_finished(directory), say):
        finish_interrupted(directory, say)
        record, config = _read_run(directory, workers)
        region = record["region"]
        yield City(directory, config, region["crs"], tuple(region.get("core", region["bounds"])))


def edit_city(
    directory: Path,
    action: str,
    name: str = "",
    upload: Upload | None = None,
    *,
    date: str = "",
    base: int | None = None,
    workers: int = 0,
    say: Callable[[str], None] = say_nothing,
) -> Outcome:
    """Replace, remove or add buildings in the city of a finished run, and mesh anew what that touches.

    Parameters
    ----------
    directory : Path
        Folder of the run.
    action : str
        ``"replace"``, ``"remove"`` or ``"add"``.
    name : str
        Id of the building that is replaced or removed.
    upload : Upload, optional
        The footprints that come.
    date : str
        Day from which on the edit holds, YYYY-MM-DD; today by default.
    base : int, optional
        Number of the last edit that the client has seen: a later one of the same building is a conflict.
    workers : int
        Worker processes; 0 for this one.
    say : callable
        Called with sentences that the user should read.

    Returns
    -------
    Outcome

    Raises
    ------
    CityError
        If the edit is refused or fails: the city is as before then.

    Notes
    -----
    The edit is worked out in a second folder, which shares all results by hard links, and moved when it is there:
    whenever this is killed, the next call finishes or forgets it.
    """
    with held_city(directory, workers, say) as city:
        found = None if upload is None else read_upload(upload, city.config, crs=city.crs, bounds=city.bounds)
        asked = Asked(action, name, found, "" if upload is None else upload.path.name, date, base)
        (outcome,) = edit_together(city, [asked], say=say)
    if isinstance(outcome, CityError):
        raise outcome
    return outcome


def edit_together(
    city: City,
    asked: Sequence[Asked],
    *,
    executor: Executor | None = None,
    city_files: bool = True,
    say: Callable[[str], None] = say_nothing,
) -> list[Outcome | CityError]:
    """Do edits in their order, and mesh what they touch in one transaction; the caller holds the folder.

    Parameters
    ----------
    city : City
        What is edited.
    asked : sequence of Asked
        Edits that wait.
    executor : Executor, optional
        Runs the tasks; by default that of the city's parameters.
    city_files : bool
        Whether the files of the city models are written too; else they are gone until `write_city_files`.
    say
        As for `edit_city`.

    Returns
    -------
    list of Outcome or CityError
        What came of each: one that is refused leaves the others as they are. Where the mesh cannot be made with
        all of them, each has a transaction of its own.
    """
    finish_interrupted(city.directory, say)
    journal = read_journal(city.directory)
    given, found = read_buildings(city.directory), list[Edit | CityError]()
    for one in asked:
        try:
            edit = make_edit(one, buildings=edit_buildings(given, journal), journal=journal)
        except CityError as error:
            found.append(error)
            continue
        found.append(edit)
        journal.append(edit)
    edits = [one for one in found if isinstance(one, Edit)]
    if not edits:
        return [one for one in found if isinstance(one, CityError)]
    try:
        done = {outcome.edit: outcome for outcome in _mesh(city, edits, executor, city_files, say)}
    except CityError as error:
        if len(edits) > 1 and not isinstance(error, OutputError | StoppedError):
            alone = partial(edit_together, executor=executor, city_files=city_files, say=say)
            return [alone(city, [one])[0] for one in asked]
        return [error if isinstance(one, Edit) else one for one in found]
    return [done[one] if isinstance(one, Edit) else one for one in found]


def _mesh(
    city: City,
    edits: Sequence[Edit],
    executor: Executor | None,
    city_files: bool,
    say: Callable[[str], None],
) -> list[Outcome]:
    """Mesh a city with further edits in its second folder, and commit it; CityError if that cannot be."""
    record, _ = read_sealed_record(city.directory / RUN_RECORD)
    try:
        work = begin(city.directory)
        for edit in edits:
            write_edit(work, edit)
        for name in () if city_files else CITY_FILES:
            (work / name).unlink(missing_ok=True)
        made = run(city.config, within=work, executor=executor, city_files=city_files)
        if lost := sorted(made["missing"].keys() - record["missing"].keys()):
            names = ", ".join(name for edit in edits for name in edit.ids)
            raise InputError(
                f"edit of {names}: tile {lost[0]} cannot be meshed with it "
                f"({made['missing'][lost[0]]['reason']}); the city is as before"
            )
        told = [tuple(describe_uploads(work, edit)) for edit in edits]
        files = commit(city.directory)
        for sentence in (one for some in told for one in some):
            say(sentence)
        return [Outcome(edit, made, files, some) for edit, some in zip(edits, told, strict=True)]
    finally:
        forget(city.directory)


def write_city_files(city: City, executor: Executor | None = None) -> None:
    """Write the files of the city models that edits have left out, all or none; CityError if they cannot be."""
    if all((city.directory / name).exists() for name in CITY_FILES):
        return
    try:
        run(city.config, within=begin(city.directory), executor=executor)
        commit(city.directory)
    finally:
        forget(city.directory)


def city_at(
    directory: Path,
    date: str,
    out: Path,
    *,
    workers: int = 0,
    say: Callable[[str], None] = say_nothing,
) -> dict[str, Any]:
    """Make the city of a day in another folder: without the edits of a later date.

    What is the same is shared by hard links, and not computed again. The folder appears whole or not at all.

    Parameters
    ----------
    directory, date, workers, say
        As for `edit_city`.
    out : Path
        Folder on the same disk, which is not there.

    Raises
    ------
    CityError
        If there is such a folder, or the city cannot be made.
    """
    refuse_bucket(directory, "the city of a day")
    day = read_date(date)
    if out.exists():
        raise ConfigError(f"{out}: is there already; give another --out")
    with only_run(_finished(directory), say):
        finish_interrupted(directory, say)
        _, config = _read_run(directory, workers, out)
        with replacing_folder(out) as work:
            link_folder(directory, work)
            for edit in read_journal(directory):
                if edit.date > day:
                    edit_path(work, edit.number).unlink()
            return run(config, within=work)


def list_edits(directory: Path, say: Callable[[str], None] = say_nothing) -> list[Edit]:
    """List the edits of a run folder, by number; what a killed one has left is finished or forgotten before.

    InputError where it holds no run, or the journal is damaged.
    """
    refuse_bucket(directory, "the journal")
    if not is_held(_finished(directory)):
        with only_run(directory, say):
            finish_interrupted(directory, say)
    return read_journal(directory)


def _finished(directory: Path) -> Path:
    """Refuse a folder that holds no run."""
    if not (directory / RUN_RECORD).is_file():
        raise InputError(f"{directory}: holds no {RUN_RECORD}; give the folder of a finished run")
    return directory


def _read_run(directory: Path, workers: int, out: Path | None = None) -> tuple[dict[str, Any], Config]:
    """Read record and parameters of a finished run that can be edited."""
    find_files(directory)  # refuses one that is not finished
    record, damage = read_sealed_record(directory / RUN_RECORD)
    if damage:
        raise InputError(f"{directory / RUN_RECORD}: {damage}; run again")
    config = make_config(
        with_file(
            {
                "pointcloud": [str(directory / CONFIG)],
                "out": str((out or directory).absolute()),
                "workers": workers,
            }
        )
    )
    both = config.buildings and config.footprints
    if both or config.align:
        why = "--footprints beside --buildings" if both else "--align: footprints that are moved"
        raise ConfigError(f"{directory}: was run with {why}, which cannot be edited yet; run again instead")
    if not config.footprints and not config.buildings:
        raise ConfigError(f"{directory}: was run without buildings; run again with footprints or a city model")
    return record, config
