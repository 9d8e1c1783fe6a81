"""What a generalisation tells: statements and counts, and the table of its levels."""

from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from pipeline.generalisation.measures import compare, count_faces
from tiler.generalisation.rows import LEVELS, Rows, level_word
from tiler.words.note_words import say_notes


@dataclass(eq=False)
class Told:
    """Statements in their order, each once, counts by what they are of, and notes on buildings by their kind."""

    said: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    notes: Counter[str] = field(default_factory=Counter)

    def say(self, text: str) -> None:
        """Add a statement."""
        if text not in self.said:
            self.said.append(text)

    def known(self) -> dict[str, int]:
        """Give the counts that are not 0, by name, those of notes by their kind."""
        return {what: n for what, n in sorted((self.counts + self.notes).items()) if n}

    def lines(self) -> list[str]:
        """Write a line for each."""
        counted = [f"{what}: {n}" for what, n in sorted(self.counts.items()) if n]
        return [*self.said, *counted, *(say_notes(kind, n) for kind, n in sorted(self.notes.items()))]


@dataclass
class LevelSum:
    """What a level has in all: objects, landmarks among them, buildings, polygons, area (m2) and volume (m3)."""

    objects: int = 0
    landmarks: int = 0
    members: int = 0
    polygons: int = 0
    area: float = 0.0
    volume: float = 0.0

    def add(self, rows: Rows) -> None:
        """Add the rows of a tile."""
        area = rows.area
        self.objects += len(rows)
        self.landmarks += int(rows.landmark.sum())
        self.members += int(rows.members.sum())
        self.polygons += int(count_faces(rows.outlines).sum())
        self.area += float(area.sum())
        self.volume += float(np.dot(area, rows.height)) if len(rows) else 0.0


def describe_levels(sums: dict[str, LevelSum]) -> dict[str, dict[str, Any]]:
    """Give the numbers of each level, and its shares of those of the buildings."""
    truth = sums[LEVELS[0]]
    return {
        level: {
            **{key: round(value, 3) for key, value in asdict(found).items()},
            "polygons_left": round(found.polygons / truth.polygons, 6) if truth.polygons else None,
            "area_error": compare(found.area, truth.area),
            "volume_error": compare(found.volume, truth.volume),
        }
        for level, found in sums.items()
    }


def table_lines(levels: dict[str, dict[str, Any]]) -> list[str]:
    """Print the table: a line a level."""
    head = ("level", "objects", "polygons", "left", "area m2", "error", "volume m3", "error")
    lines = ["{:<7}{:>9}{:>10}{:>8}{:>13}{:>9}{:>14}{:>9}".format(*head)]
    for level, row in levels.items():
        lines.append(
            f"{'LoD' + level_word(level):<7}{row['objects']:>9,}{row['polygons']:>10,}"
            f"{_share(row['polygons_left']):>8}{row['area']:>13,.0f}{_signed(row['area_error']):>9}"
            f"{row['volume']:>14,.0f}{_signed(row['volume_error']):>9}"
        )
    return lines


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _signed(value: float | None) -> str:
    return "-" if value is None else f"{round(value, 3) + 0.0:+.1%}"
