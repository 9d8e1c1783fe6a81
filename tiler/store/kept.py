"""What of a finished run stays in its folder: the store of its results, the pieces of its mesh, or both."""

import json
from collections.abc import Iterable

from pipeline.data.errors import ConfigError
from tiler.config.config import KEPT
from tiler.objects.places import Place, remove
from tiler.store.out_folder import INDEXES, PIECES, RUN_RECORD, STORE

WHOLE, IN_STORE, IN_PIECES = KEPT
# What stays with the pieces: the stage that states their checksums, and what `check` holds them against.
OF_PIECES = ("pieces", "terrain", "approach", "levelled", "covered", "levels", "leaves", "blocks", "block-cells")


def is_kept(stage: str, keep: str) -> bool:
    """Return whether the results of a stage stay in the store.

    Examples
    --------
    >>> [[stage for stage in ("points", "terrain", "pieces") if is_kept(stage, keep)] for keep in KEPT]
    [['points', 'terrain', 'pieces'], ['points', 'terrain'], ['terrain', 'pieces']]
    """
    return {WHOLE: True, IN_STORE: stage != "pieces", IN_PIECES: stage in OF_PIECES}[keep]


def remove_dropped(out: Place, stages: Iterable[str], keep: str) -> None:
    """Remove from the folder of a run what is not kept, once its manifest names the rest alone."""
    dropped = [out / STORE / stage for stage in stages if not is_kept(stage, keep)]
    dropped += [out / name for name in (*INDEXES, *PIECES) if keep == IN_STORE]
    for path in dropped:
        remove(path)


def need(directory: Place, *parts: str) -> None:
    """Raise ConfigError where a run has not kept what a command reads, `IN_STORE` or `IN_PIECES`."""
    keep = find_kept(directory)
    if keep != WHOLE and (dropped := set(parts) - {keep}):
        raise ConfigError(
            f"{directory}: has no {dropped.pop()}, its run kept the {keep} alone (--keep {keep}); run again with "
            f"--keep {WHOLE}"
        )


def find_kept(directory: Place) -> str:
    """Find what a run was to keep; both, where its record is of another build or damaged: its readers say so."""
    try:
        keep = json.loads((directory / RUN_RECORD).read_bytes())["parameters"]["keep"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return WHOLE
    return keep if keep in KEPT else WHOLE
