"""The plan of a run as an object: its numbers, and the text that `citystitch plan` prints."""

from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tiler.config.config import Config
from tiler.interface.city_mesh import VectorPicture


@dataclass(frozen=True, eq=False)
class RunPlan:
    """What a run would do and take; a notebook shows the text."""

    config: Config  #: parameters of the run
    #: the plan as `citystitch plan --json` writes it: region, tiles, files, tasks, cells, memory, seconds
    facts: dict[str, Any]
    text: str  #: the same as text

    def __repr__(self) -> str:
        return self.text.rstrip("\n")

    def picture(self) -> VectorPicture:
        """Draw tiles, files and footprints.

        Raises
        ------
        CityError
            If an input is no longer as it was.
        """
        with TemporaryDirectory() as place:
            path = Path(place) / "plan.svg"
            _plan(self.config, path)
            return VectorPicture(path.read_text())


def plan_config(config: Config) -> RunPlan:
    """Plan a run from headers alone; parameters and errors as for `tiler.report.plan_report.plan_run`."""
    facts, text = _plan(config, None)
    return RunPlan(config, facts, text)


def _plan(config: Config, picture: Path | None) -> tuple[dict[str, Any], str]:
    from rich.console import Console

    from tiler.report.plan_report import WIDTH, plan_run

    text = StringIO()
    # Rich would write colours, or to the notebook itself.
    console = Console(file=text, width=WIDTH, highlight=False, color_system=None, force_jupyter=False)
    facts = plan_run(config, picture=picture, console=console)
    return facts, text.getvalue()
