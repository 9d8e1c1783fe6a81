"""What campaigns of tests leave for `make reliability`: JSON in the folder of ``CITYSTITCH_RELIABILITY``."""

import json
import os
from pathlib import Path
from typing import Any


def keep_outcome(campaign: str, **outcome: Any) -> None:
    """Add an outcome to the list of a campaign; nothing happens if the environment names no folder.

    Parameters
    ----------
    campaign : str
        Name of the file.
    **outcome
        Plain JSON values.
    """
    folder = os.environ.get("CITYSTITCH_RELIABILITY")
    if not folder:
        return
    path = Path(folder) / f"{campaign}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    earlier: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    path.write_text(json.dumps([*earlier, outcome], indent=1) + "\n")
