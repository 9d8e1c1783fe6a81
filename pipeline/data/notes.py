"""Notes: what a step dropped, repaired or defaulted, with its place, for the report."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Note:
    """One thing that was not taken as it came."""

    kind: str  #: what happened, in kebab case, one fixed word per rule: ``"footprint-duplicate"``
    subject: str = ""  #: id of the building, name of the file, or ``""`` where the note has neither
    #: place in the region's CRS (m); NaN where there is none
    x: float = float("nan")
    y: float = float("nan")
    detail: str = ""  #: the observed value against its bound, in words, or ``""``


def count_notes(notes: Iterable[Note]) -> dict[str, int]:
    """Count the notes of each kind, kinds in alphabetical order.

    Examples
    --------
    >>> count_notes([Note("b"), Note("a"), Note("b")])
    {'a': 1, 'b': 2}
    """
    return dict(sorted(Counter(note.kind for note in notes).items()))
