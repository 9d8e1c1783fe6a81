"""Results and files put into a bucket whole: written on the disk of the worker first, the naming object last."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tiler.objects.path import ObjectPath

PREFIX = "citystitch-"  # of temporary folders


def publish(folder: Path, target: ObjectPath, last: str) -> None:
    """Put the files of a folder; one that names the others and their checksums is the last.

    Parameters
    ----------
    folder : Path
        Files of a result, on a disk.
    target : ObjectPath
        Where the result will be.
    last : str
        The file that is last: whoever finds it, finds all others.

    Notes
    -----
    An earlier result of other bytes is taken away first, by the same file: a writer that is killed leaves no
    result, never parts of two. Two writers of the same bytes do not disturb each other.
    """
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*")) if path.is_file()}
    there = target.list_sizes()
    if last in there and (target / last).read_bytes() != files[last].read_bytes():
        (target / last).unlink()
    target.delete([target / name for name in sorted(there.keys() - files.keys())])
    for name, path in files.items():
        if name != last:
            (target / name).put_file(path)
    (target / last).put_file(files[last])


@contextmanager
def files_for(target: ObjectPath) -> Iterator[Path]:
    """Give an empty folder on a disk; what is in it at the end is put below a name, each file whole.

    The folders ``mesh`` and ``boundary`` of pieces are there.
    """
    with tempfile.TemporaryDirectory(prefix=PREFIX, ignore_cleanup_errors=True) as name:
        folder = Path(name)
        for part in ("mesh", "boundary"):
            (folder / part).mkdir()
        yield folder
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                (target / path.relative_to(folder).as_posix()).put_file(path)
