"""Write the report of a run folder."""

from pathlib import Path

from pipeline.data.errors import ConfigError, InputError
from tiler.report import sections
from tiler.report.collect import collect_numbers
from tiler.report.page import Page, paragraph
from tiler.report.pictures import describe_pictures
from tiler.report.record import RunFacts, read_run_facts
from tiler.report.roof_truth import compare_with_truth, describe_truth
from tiler.report.samples import measure_samples
from tiler.report.timeline import read_timeline
from tiler.store.atomic import replacing
from tiler.store.kept import IN_PIECES, IN_STORE, need
from tiler.store.out_folder import EVENTS, REPORT, RUN_RECORD, STORE
from tiler.store.run_folder import WRONG_FIELD, broken_field
from tiler.store.store import Store


def write_report(directory: Path, *, truth: Path | None = None) -> Path:
    """Write ``report.html`` of a run: one file that needs no other and no network.

    Parameters
    ----------
    directory : Path
        Folder of a run that is done, or that failed.
    truth : Path, optional
        ``truth.jsonl`` of the synthetic town that was meshed, against which its roofs are held.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    ConfigError
        If there is no such folder, or the truth is that of another town.
    InputError
        If its record or a result is missing or damaged, or the run is at work.
    OutputError
        If the page cannot be written.

    Notes
    -----
    It holds times: it is no result. Tiles are read one by one; memory is that of one of them, and of the page.
    """
    if not directory.is_dir():
        raise ConfigError(f"{directory}: no such folder; give the folder of a run")
    need(directory, IN_STORE, IN_PIECES)
    facts = read_run_facts(directory)
    try:
        page = _fill(directory, facts, truth)
    except WRONG_FIELD as error:
        raise broken_field(directory / RUN_RECORD, error) from error
    target = directory / REPORT
    with replacing(target) as part:
        part.write_text(page.finish(), encoding="utf-8")
    return target


def _fill(directory: Path, facts: RunFacts, truth: Path | None) -> Page:
    timeline = read_timeline(directory / EVENTS, frozenset(facts.tiles.names))
    page = Page(f"citystitch: {directory.resolve().name}")
    page.section("summary", "Summary", sections.describe_summary(facts))
    if facts.members["status"] == "done":
        if not (directory / STORE).is_dir():
            raise InputError(f"{directory / STORE}: is missing; run again")
        numbers = collect_numbers(Store(directory / STORE), facts)
        assert facts.bounds is not None  # as of every run that is done
        filtered = bool(facts.members["parameters"]["ground_filter"])
        samples = measure_samples(directory, facts.bounds, ground_filter=filtered)
        page.section("pictures", "Pictures", describe_pictures(directory))
        page.section("map", "Map", sections.describe_map(facts, numbers, timeline))
        page.section("quality", "Quality of cells", sections.describe_quality(facts, numbers, samples))
        page.section("heights", "Heights", sections.format_heights(facts, numbers))
        page.section("fidelity", "Fidelity to the input", sections.describe_fidelity(facts, samples))
        if truth is not None:
            page.section("truth", "Fidelity to the truth", describe_truth(compare_with_truth(directory, truth)))
    elif truth is not None:
        status = facts.members["status"]
        raise ConfigError(f"{directory}: its run {status}; it has no roofs yet to hold against {truth}, run again")
    page.section("time", "Time", sections.format_time(facts, timeline))
    page.section("notes", "Dropped, repaired, defaulted", sections.describe_notes(facts))
    page.section("parameters", "Parameters and versions", sections.report_parameters(facts))
    page.lead = paragraph("What one run made, how good it is, what was left out, and where the time went.", "soft")
    return page
