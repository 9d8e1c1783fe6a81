"""Campaigns of tests: `make reliability` runs all rounds and keeps what came of them, CI runs some.
Properties that hypothesis draws examples of have three times as many there.

The environment variable ``CITYSTITCH_RELIABILITY`` names the folder of what is kept, and asks for all rounds.
"""

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

Round = TypeVar("Round")
FOLDER = "CITYSTITCH_RELIABILITY"
ALL_ROUNDS = bool(os.environ.get(FOLDER))


def rounds(some: Iterable[Round], others: Iterable[Round]) -> list[Round]:
    """Give the rounds of a campaign: some, and the others too where all are asked for.

    Parameters
    ----------
    some, others : iterable
        What a test is parametrized with; `some` has each kind of kill or fault at least once.

    Returns
    -------
    list
        Of the same.
    """
    return [*some, *others] if ALL_ROUNDS else [*some]


def examples(n: int) -> int:
    """Give the number of examples that hypothesis draws: n where all rounds are asked for, else a third."""
    return n if ALL_ROUNDS else n // 3


def keep_outcome(campaign: str, **outcome: Any) -> None:
    """Add an outcome to the list of a campaign; nothing happens if the environment names no folder.

    Parameters
    ----------
    campaign : str
        Name of the file.
    **outcome
        Plain JSON values.
    """
    folder = os.environ.get(FOLDER)
    if not folder:
        return
    path = Path(folder) / f"{campaign}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    earlier: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    path.write_text(json.dumps([*earlier, outcome], indent=1) + "\n")
