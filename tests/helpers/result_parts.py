"""The file of a result taken apart and put together again, with right checksums."""

from pathlib import Path
from zipfile import ZipFile, ZipInfo

from tiler.store.checksums import TAIL, seal_file


def parts(file: Path) -> dict[str, bytes]:
    """Files of a result, by name."""
    with ZipFile(file) as found:
        return {name: found.read(name) for name in found.namelist()}


def write_parts(file: Path, files: dict[str, bytes]) -> None:
    """Write the file of a result anew."""
    with ZipFile(file, "w") as archive:
        archive.comment = b"0" * TAIL
        for name, data in files.items():
            archive.writestr(ZipInfo(name), data)
    seal_file(file)
