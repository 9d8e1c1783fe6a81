"""The parameters that a stage declares, as its function sees them."""

from collections.abc import Mapping
from typing import Any


class Declared:
    """The declared parameters of a stage as attributes; ValueError for one that it does not declare.

    Parameters
    ----------
    stage : str
        Name of the stage.
    values : mapping
        Its parameters.
    """

    def __init__(self, stage: str, values: Mapping[str, Any]) -> None:
        self._stage = stage
        self._values = dict(values)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in self._values:
            raise ValueError(f"stage {self._stage} uses parameter {name}, which it does not declare")
        return self._values[name]

    def get(self, name: str, default: Any) -> Any:
        """Value of a parameter that is declared only where it counts; the default where it is not."""
        return self._values.get(name, default)
