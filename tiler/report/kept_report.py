"""The report of an earlier run: kept where nothing has changed since, else marked as old."""

from pathlib import Path

from pipeline.data.errors import OutputError
from tiler.store.atomic import replacing
from tiler.store.out_folder import EARLIER_REPORT, REPORT

OLD = (
    '<p class="bad" role="note">This report is old: it tells of an earlier run in this folder, and the mesh was '
    "changed since. citystitch report writes a new one.</p>\n"
)
PLACE = "</header>"  # where the page says so


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
