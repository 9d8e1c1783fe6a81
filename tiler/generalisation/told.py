"""What must be known of a generalisation: statements, and numbers of what was left out or changed."""

from collections import Counter
from dataclasses import dataclass, field

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
