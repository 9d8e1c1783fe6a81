"""The folder of a run: refuse what is not ours or finished, go on where a run ended early, or start anew."""

import errno
import fcntl
import json
import os
import shutil
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipeline.errors import ConfigError
from tiler.stages.citymodel import CITY_MODEL, FULL_CITY_MODEL

# What a run writes, and all that --overwrite removes.
INDEXES = ("mesh.pvtu", "boundary.pvtp")
PIECES = {"mesh": ".vtu", "boundary": ".vtp"}
RESULTS = ("run.json", CITY_MODEL, FULL_CITY_MODEL, *INDEXES, *PIECES, "store.zarr")
UNFINISHED = ("running", "failed")


def check_folder(out: Path, *, overwrite: bool) -> list[str]:
    """Refuse an output folder that holds something to keep.

    Parameters
    ----------
    out : Path
        The folder; made if it is missing.
    overwrite : bool
        Results of a finished run may be replaced.

    Returns
    -------
    list of str
        The results of an earlier run that are there, finished or not.

    Raises
    ------
    ConfigError
        If it cannot be written, holds results without the record of a run, or those of a finished run.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; give another --out")
    earlier = [name for name in RESULTS if (out / name).exists()]
    if earlier and not (out / "run.json").is_file():
        raise ConfigError(f"{out}: holds {', '.join(earlier)}, but no run.json of a run; give another --out")
    if earlier and not overwrite and not _is_unfinished(out / "run.json"):
        raise ConfigError(
            f"{out}: holds the results of another run ({', '.join(earlier)}); give another --out, or --overwrite"
        )
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); give another --out") from error
    if not os.access(out, os.W_OK):
        raise ConfigError(f"{out}: cannot be written; give another --out")
    return earlier


def clear_folder(out: Path, earlier: Sequence[str], *, overwrite: bool) -> None:
    """Make the folders of a run; of an unfinished one only the indexes go, and its results are used again.

    Parameters
    ----------
    out : Path
        The folder.
    earlier : sequence of str
        From `check_folder`.
    overwrite : bool
        Remove all results of the earlier run.

    Raises
    ------
    ConfigError
        If it cannot be written.
    """
    try:
        for name in earlier if overwrite else set(INDEXES) & set(earlier):
            path = out / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for folder in PIECES:
            (out / folder).mkdir(exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror}); give another --out") from error


def remove_strangers(out: Path, tiles: Collection[str]) -> None:
    """Remove pieces that an unfinished run has left for tiles which are not of this one."""
    for folder, suffix in PIECES.items():
        for path in (out / folder).glob(f"*{suffix}"):
            if path.stem not in tiles:
                path.unlink()


@contextmanager
def only_run(out: Path) -> Iterator[None]:
    """Hold a folder for one run at a time; the hold ends with the process, however it ends.

    Raises
    ------
    ConfigError
        If another run is at work there.

    Notes
    -----
    A lock of the system on the folder. Where its file system knows no locks, there is none.
    """
    held = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in {errno.EWOULDBLOCK, errno.EACCES}:
                raise ConfigError(
                    f"{out}: another run is at work there; wait for its end, or give another --out"
                ) from error
        yield
    finally:
        os.close(held)


def _is_unfinished(path: Path) -> bool:
    try:
        return json.loads(path.read_text())["status"] in UNFINISHED
    except (OSError, ValueError, KeyError, TypeError):
        return False
