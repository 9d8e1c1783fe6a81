"""States of an item of a run, as small numbers, and how those of many come to one."""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Codes = NDArray[np.uint8]


class State(IntEnum):
    """What is known of an item; `BEGUN` is a tile of which some stages are done and none is at work."""

    WAITING = 0
    BEGUN = 1
    RUNNING = 2
    DONE = 3
    REUSED = 4
    FAILED = 5


STATES = tuple(state.name.lower() for state in State)


def tally(codes: Codes, group: NDArray[np.int64], n_groups: int) -> NDArray[np.int64]:
    """Count states in groups.

    Parameters
    ----------
    codes : uint8, (n,)
        A `State` each.
    group : int64, (n,)
        The group of each, from 0.
    n_groups : int
        Number of groups.

    Returns
    -------
    int64, (n_groups, 6)
        Number of items in each state.

    Examples
    --------
    >>> tally(np.array([3, 3, 5], np.uint8), np.array([0, 1, 1]), 2).tolist()
    [[0, 0, 0, 1, 0, 0], [0, 0, 0, 1, 0, 1]]
    """
    n = len(State)
    return np.bincount(group * n + codes, minlength=n_groups * n).reshape(n_groups, n)


def combine(counts: NDArray[np.int64]) -> Codes:
    """Bring the states of many to one: failed if any failed, at work if any is, done if all are.

    Parameters
    ----------
    counts : int64, (n, 6)
        Number of items in each state, from `tally`.

    Returns
    -------
    uint8, (n,)
        A `State` each; `State.WAITING` where there is no item.

    Examples
    --------
    >>> rows = [[0, 0, 0, 2, 0, 1], [1, 0, 1, 1, 0, 0], [1, 0, 0, 1, 0, 0], [0, 0, 0, 1, 1, 0], [0, 0, 0, 0, 2, 0]]
    >>> combine(np.array(rows)).tolist()
    [5, 2, 1, 3, 4]
    """
    total = counts.sum(axis=1)
    done = counts[:, State.DONE] + counts[:, State.REUSED]
    found = np.zeros(len(counts), np.uint8)
    found[(done > 0) | (counts[:, State.BEGUN] > 0)] = State.BEGUN
    found[(done == total) & (total > 0)] = State.DONE
    found[(counts[:, State.REUSED] == total) & (total > 0)] = State.REUSED
    found[counts[:, State.RUNNING] > 0] = State.RUNNING
    found[counts[:, State.FAILED] > 0] = State.FAILED
    return found
