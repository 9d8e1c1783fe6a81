"""What must be known of a generalisation: statements, and numbers of what was left out or changed."""

from collections import Counter
from dataclasses import dataclass, field


@dataclass(eq=False)
class Told:
    """Statements in their order, each once, and counts by what they are of."""

    said: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)

    def say(self, text: str) -> None:
        """Add a statement."""
        if text not in self.said:
            self.said.append(text)

    def known(self) -> dict[str, int]:
        """Give the counts that are not 0, by name."""
        return {what: n for what, n in sorted(self.counts.items()) if n}

    def lines(self) -> list[str]:
        """Write a line for each."""
        return [*self.said, *(f"{n} {what}" for what, n in self.known().items())]
