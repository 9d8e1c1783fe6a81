"""A configuration file below the parameters that are given."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError
from tiler.config.config import Config, check_reach, load_config

POSITIONAL = "pointcloud"
PARAMETERS = tuple(entry.name for entry in dataclasses.fields(Config))


def with_file(options: Mapping[str, Any]) -> dict[str, Any]:
    """Put the parameters of a configuration file below those that are given.

    Parameters
    ----------
    options : mapping
        With ``pointcloud``, a list of sources, one of which may be a configuration file. What is no parameter of a
        run is passed over.

    Raises
    ------
    ConfigError
        If several configuration files are given, or one cannot be read or asks for what it may not.
    """
    values = {name: value for name, value in options.items() if name in PARAMETERS}
    sources: list[str] = values.pop(POSITIONAL)
    files = [source for source in sources if source.lower().endswith(".toml")]
    if len(files) > 1:
        raise ConfigError(f"{len(files)} configuration files given ({', '.join(files)}); give one")
    clouds = [source for source in sources if source not in files]
    given = load_config(Path(files[0])) if files else {}
    if files:
        check_reach(Path(files[0]), {name: value for name, value in given.items() if name not in values})
    return given | ({POSITIONAL: clouds} if clouds else {}) | values
