"""The folder of a run: refuse what is not ours, bring the results of an earlier run up to date, or start anew."""

import json
import os
import shlex
from collections.abc import Collection, Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError, OutputError
from tiler.objects.places import Place, find_within, in_bucket, remove
from tiler.store.atomic import replacing
from tiler.store.store import MANIFEST

# What a run writes, and all that --overwrite removes; the record is replaced.
INDEXES = ("mesh.pvtu", "boundary.pvtp")
PIECES = {"mesh": ".vtu", "boundary": ".vtp"}
CITY_MODEL, FULL_CITY_MODEL = "citymodel.city.json", "citymodel-full.city.json"  # that was meshed, and before
CONFIG = "config.toml"  # parameters of the run
TASKS = ".tasks"  # folder beside the store, with a file for every task that runs
PROBE = ".cluster.json"  # as long as the tasks of a run are on a cluster
RUN_RECORD, PROGRESS, EVENTS, STORE = "run.json", "progress.json", "events.jsonl", "store.zarr"
MANIFEST_PATH = f"{STORE}/{MANIFEST}"
REPORT = "report.html"
EARLIER_REPORT = ".report.earlier.html"  # set aside while a run is at work: see `tiler.store.out_folder`
STALE = (*INDEXES, REPORT)  # what an earlier run said of all of its mesh
RESULTS = (
    *(RUN_RECORD, PROGRESS, EVENTS, REPORT, EARLIER_REPORT, CONFIG, CITY_MODEL, FULL_CITY_MODEL),
    *(*INDEXES, *PIECES, STORE, TASKS, "only"),
)
# A file on its way to its place, of a writer that was killed: see `tiler.store.atomic`.
PART = ".{stem}.*.part{suffix}"
OLD = (
    '<p class="bad" role="note">This report is old: it tells of an earlier run in this folder, and the mesh was '
    "changed since. citystitch report writes a new one.</p>\n"
)
PLACE = "</header>"  # where the page says so


def has_record(out: str) -> bool:
    """Tell whether a folder on a disk has the record of a run."""
    return (Path(out) / RUN_RECORD).is_file()


def check_folder(out: Path, *, overwrite: bool) -> list[str]:
    """Refuse an output folder that holds something of others.

    Parameters
    ----------
    out : Path
        The folder; made if it is missing.
    overwrite : bool
        The record of the earlier run need not be readable.

    Returns
    -------
    list of str
        The results of an earlier run that are there, finished or not.

    Raises
    ------
    ConfigError
        If it cannot be written, or holds results without the record of a run; or if it, or a folder of results in
        it, is a symbolic link: what is removed there would be somewhere else.
    """
    if in_bucket(out):
        return _check_bucket(out, overwrite=overwrite)
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; give another --out")
    refuse_links(out)
    earlier = [name for name in RESULTS if (out / name).exists()]
    _check_earlier(out, earlier, overwrite=overwrite)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); give another --out") from error
    if not os.access(out, os.W_OK):
        raise ConfigError(f"{out}: cannot be written; give another --out")
    return earlier


def _check_bucket(out: Place, *, overwrite: bool) -> list[str]:
    """As `check_folder`; whether it can be written is known when the lease is."""
    try:
        there = {path.name for path in out.iterdir()}
    except OSError as error:
        raise ConfigError(f"{out}: cannot be read ({error.strerror}); give another --out") from error
    earlier = [name for name in RESULTS if name in there]
    _check_earlier(out, earlier, overwrite=overwrite)
    return earlier


def _check_earlier(out: Place, earlier: Sequence[str], *, overwrite: bool) -> None:
    if earlier and not _is_ours(out):
        raise ConfigError(f"{out}: holds {', '.join(earlier)}, but no run.json of a run; give another --out")
    if earlier and not overwrite and not _has_record(out):
        raise ConfigError(
            f"{out / RUN_RECORD}: is not the record of a run; give another --out, or --overwrite to remove "
            f"{', '.join(earlier)}"
        )


def clear_folder(out: Path, earlier: Sequence[str], *, overwrite: bool) -> None:
    """Make the folders of a run; take away the indexes of an earlier one, and set its report aside.

    ``run.json`` stays: it must say before this that a run is at work. Other results are used again.

    Parameters
    ----------
    out : Path
        The folder.
    earlier : sequence of str
        From `check_folder`.
    overwrite : bool
        Remove all other results of the earlier run too.

    Raises
    ------
    ConfigError
        If it cannot be written.
    """
    refuse_links(out)
    try:
        for name in RESULTS if overwrite else STALE:
            path = out / name
            if name == RUN_RECORD or name not in earlier:
                continue
            if name == REPORT and not overwrite and not in_bucket(out):
                path.replace(out / EARLIER_REPORT)
            else:
                remove(path)
        for folder in PIECES:
            (out / folder).mkdir(exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); give another --out") from error


def remove_strangers(out: Path, tiles: Collection[str]) -> None:
    """Remove what earlier runs have left: pieces of tiles that are gone, and files that were never finished.

    Raises
    ------
    OutputError
        If one cannot be removed.
    """
    refuse_links(out)
    try:
        _remove_strangers(out, tiles)
    except OSError as error:
        raise OutputError(
            f"{error.filename}: cannot be removed ({error.strerror}); check its permissions"
        ) from error


def _remove_strangers(out: Place, tiles: Collection[str]) -> None:
    for folder, suffix in PIECES.items():
        for path in (out / folder).glob(f"*{suffix}"):
            if path.stem not in tiles:
                path.unlink()
    names = [Path(name) for name in (*RESULTS, PROBE)]
    unfinished = [PART.format(stem=name.stem, suffix=name.suffix) for name in names]
    for path in out.iterdir():
        if any(fnmatchcase(path.name, pattern) for pattern in (PROBE, *unfinished)) and path.is_file():
            path.unlink()


def refuse_links(out: Place) -> None:
    """Raise ConfigError if the folder of a run, or a folder of results in it, is a symbolic link."""
    store = out / STORE
    stages = sorted(store.iterdir(), key=str) if store.is_dir() and not store.is_symlink() else []
    for path in (out, *(out / name for name in RESULTS), *stages):
        if path.is_symlink():
            raise ConfigError(
                f"{path}: is a symbolic link to {os.readlink(str(path))}; give the folder itself as --out, or "
                "remove the link"
            )


def refuse_inputs_within(out: Path, inputs: Iterable[Path]) -> None:
    """Refuse inputs that lie where a run writes and `clear_folder` removes.

    Raises
    ------
    ConfigError
        With the first such input.
    """
    path = find_within(inputs, _list_results(out))
    if path is not None:
        raise ConfigError(f"{path}: an input lies among the results in {out}; move it, or give another --out")


def refuse_result(out: Path, log: Path) -> None:
    """Refuse a file for `--log-json` that a run writes or removes itself; ConfigError with its name."""
    if find_within([log], _list_results(out)) is not None:
        raise ConfigError(f"--log-json {log}: lies among the results in {out}; give another file")


def _list_results(out: Path) -> list[Path]:
    return [out / name for name in RESULTS]


def _is_ours(out: Place) -> bool:
    """Return whether a run has been in a folder: a lost record is mended."""
    return any((out / name).is_file() for name in (RUN_RECORD, PROGRESS, MANIFEST_PATH))


def _has_record(out: Place) -> bool:
    """Return whether some file says what run it was; a damaged one is mended."""
    if (out / MANIFEST_PATH).is_file():
        return True
    return any(
        isinstance(found.get("status"), str) and "schema" in found
        for found in (_read_object(out / name) for name in (RUN_RECORD, PROGRESS))
    )


def _read_object(path: Place) -> dict[str, Any]:
    """Read a JSON object; an empty one where there is none."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def command_alone(out: Path, tile: str) -> str:
    """The command that runs one tile alone."""
    return shlex.join(["citystitch", "run", str(out / CONFIG), "--only", tile, "--traceback"])


def give_back_report(out: Path, *, changed: bool) -> None:
    """Put the report of an earlier run back, which `out_folder.clear_folder` has set aside.

    Parameters
    ----------
    out : Path
        Folder of a run that is done.
    changed : bool
        Whether the run has changed anything: the report then says that it is old, once.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    earlier, report = out / EARLIER_REPORT, out / REPORT
    try:
        if not earlier.is_file():
            return
        if changed:
            page = earlier.read_text(encoding="utf-8", errors="replace")
            if OLD not in page:
                with replacing(earlier) as part:
                    part.write_text(page.replace(PLACE, OLD + PLACE, 1), encoding="utf-8")
        earlier.replace(report)
    except OSError as error:
        raise OutputError(f"{report}: cannot be written ({error.strerror}); check its permissions") from error
