"""Throughput and memory over time, in a bounded number of intervals."""

from dataclasses import dataclass

MOST = 200  # intervals; when there are more, two become one


@dataclass
class Interval:
    """What happened in an interval.

    Attributes
    ----------
    done : int
        Items that were finished, those taken from an earlier run left out.
    seconds : float
        Their wall time (s).
    memory : int
        Largest memory of a process that any of them told (bytes); 0 if none.
    running : int
        Items at work at its end; -1 if nothing was told.
    """

    done: int = 0
    seconds: float = 0.0
    memory: int = 0
    running: int = -1


class Series:
    """Intervals of equal length since the start; their length doubles when there are too many.

    Examples
    --------
    >>> series = Series()
    >>> for t in (100.0, 100.5, 350.0):
    ...     series.add(t, seconds=2.0, memory=10, running=1)
    >>> series.width, series.rows()[0]
    (2.0, [2, 4.0, 10, 1])
    """

    def __init__(self) -> None:
        self.width = 1.0
        self._begin: float | None = None
        self._intervals: list[Interval] = []

    def add(self, t: float, *, seconds: float, memory: int, running: int, done: int = 1) -> None:
        """Add an item that was finished at `t` (s); a time before the start counts as the start."""
        self._begin = t if self._begin is None else self._begin
        since = max(t - self._begin, 0.0)
        while since >= MOST * self.width:
            self._halve()
        k = int(since / self.width)
        self._intervals += [Interval() for _ in range(k + 1 - len(self._intervals))]
        one = self._intervals[k]
        one.done += done
        one.seconds += seconds
        one.memory, one.running = max(one.memory, memory), running

    def rows(self) -> list[list[float]]:
        """Give done, seconds, memory and running of each interval; what was not told is that of the one before."""
        rows, running, memory = [], 0, 0
        for one in self._intervals:
            running = one.running if one.running >= 0 else running
            memory = one.memory or memory
            rows.append([one.done, round(one.seconds, 2), memory, running])
        return rows

    def _halve(self) -> None:
        self.width *= 2
        pairs = [self._intervals[k : k + 2] for k in range(0, len(self._intervals), 2)]
        self._intervals = [
            Interval(
                sum(one.done for one in pair),
                sum(one.seconds for one in pair),
                max(one.memory for one in pair),
                next((one.running for one in reversed(pair) if one.running >= 0), -1),
            )
            for pair in pairs
        ]
