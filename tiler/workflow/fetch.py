"""`citystitch fetch`: the folder of a run from a bucket, every file held against its checksum."""

from collections.abc import Callable
from pathlib import Path, PurePosixPath

from pipeline.data.errors import ConfigError, InputError
from tiler.objects.path import ObjectPath
from tiler.objects.places import in_bucket, place
from tiler.objects.results import copy_object
from tiler.store.atomic import replacing
from tiler.store.folder_lock import LOCK, is_held, only_run
from tiler.store.out_folder import check_folder
from tiler.workflow.audit import Audit


def fetch_run(source: str, folder: Path, tell: Callable[[str], None]) -> bool:
    """Fetch all that a run has put into a bucket.

    Parameters
    ----------
    source : str
        ``s3://BUCKET/NAME`` of the run.
    folder : Path
        A new folder, or one of an earlier fetch: files of the same size are not fetched again.
    tell : callable
        Called with a line on what was fetched, and one for each file that is not as it was written.

    Returns
    -------
    bool
        Whether all is as it was written; then the folder is as one of a run on a disk.

    Raises
    ------
    ConfigError
        If the source is no bucket, or the folder holds something else.
    InputError
        If there is no run, one is at work there, or an object has a name that would lead out of the folder.
    """
    target = place(source)
    if not in_bucket(target) or not target.root.startswith("s3://"):
        raise ConfigError(f"{source}: is no run in a bucket; give s3://BUCKET/NAME")
    try:
        sizes = target.list_sizes()
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror}); check the URL") from error
    if not sizes:
        raise InputError(f"{source}: nothing lies below; check the name of the run")
    if is_held(place(source)):
        raise InputError(f"{source}: a run is at work there; wait for its end")
    sizes.pop(LOCK, None)
    for name in sizes:
        _check_name(target, name)
    check_folder(folder, overwrite=False)
    with only_run(folder, tell):
        n_fetched = sum(_fetch(target / name, folder / name, size) for name, size in sorted(sizes.items()))
    n_there, size = len(sizes) - n_fetched, sum(sizes.values()) / 1e6
    tell(f"{folder}: {n_fetched} files fetched, {n_there} were there, {size:.1f} MB")
    damage = list(Audit(folder, deep=False))
    for one in damage:
        tell(f"DAMAGED {one}")
    return not damage


def _check_name(target: ObjectPath, name: str) -> None:
    parts = PurePosixPath(name).parts
    if name.startswith("/") or "/".join(parts) != name or ".." in parts or "\0" in name or "\\" in name:
        raise InputError(f"{target}: has an object {name!r}, which can be no file of a folder; remove it there")


def _fetch(source: ObjectPath, path: Path, size: int) -> bool:
    """Fetch a file; False if one of its size is there."""
    if path.is_file() and path.stat().st_size == size:
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with replacing(path) as part:
            copy_object(source, part)
    except FileNotFoundError as error:
        raise InputError(f"{source}: was taken away meanwhile; fetch again") from error
    return True
