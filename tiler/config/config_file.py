"""Parameters of a run as TOML: read, put below those that are given, and written."""

import dataclasses
import json
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError
from tiler.config.config import INPUTS, TLS, UNSET, Config, change_places
from tiler.objects.places import is_url
from tiler.words.plain_text import shorten, suggest

POSITIONAL = "pointcloud"
PARAMETERS = tuple(entry.name for entry in dataclasses.fields(Config))
MAX_CONFIG_BYTES = 1_000_000


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


def load_config(path: Path) -> dict[str, Any]:
    """Read the parameters that a TOML file gives.

    Raises
    ------
    ConfigError
        If the file cannot be read, is no TOML, or has an unknown section or parameter.

    Notes
    -----
    Relative paths of inputs and of the output folder are taken from the file's folder.
    """
    document = _read_toml(path)
    values: dict[str, Any] = {}
    sections = {entry.name: entry.metadata["section"] for entry in dataclasses.fields(Config)}
    for section, table in document.items():
        if section not in sections.values() or not isinstance(table, dict):
            offer = suggest(section, sections.values())
            raise ConfigError(
                f"{path}: unknown section [{shorten(section, 100)}]{offer}; `citystitch config` lists all"
            )
        for name, value in table.items():
            if sections.get(name) != section:
                offer = f"; it stands in [{sections[name]}]" if name in sections else suggest(name, sections)
                raise ConfigError(
                    f"{path}: unknown parameter {shorten(name, 100)} in [{section}]{offer}; `citystitch config` "
                    "lists all"
                )
            values[name] = _relative_to(path.parent, name, value)
    return values


def check_reach(path: Path, values: Mapping[str, Any]) -> None:
    """Refuse what a configuration file may not decide, as it may come from someone else.

    Parameters
    ----------
    values : mapping
        The parameters that it gives, less those that the command line gives.

    Raises
    ------
    ConfigError
        If the output folder lies outside the file's folder, by ``..``, an absolute path or a symbolic link; or if
        it names a scheduler, or a cluster: who connects to one runs what it sends.
    """
    out = values.get("out", UNSET)
    if isinstance(out, str) and "\0" not in out:
        if is_url(out):
            raise ConfigError(f"{path}: out leads to {out}; give it on the command line, with --out")
        home, target = (Path(os.path.realpath(place)) for place in (path.parent, out or "."))
        if out and not target.is_relative_to(home):
            raise ConfigError(
                f"{path}: out leads to {target}, outside the folder of the file; give it on the command line, "
                "with --out"
            )
    if values.get("scheduler"):
        raise ConfigError(
            f"{path}: a file may not name a scheduler, as its address is trusted with this machine; give it on "
            "the command line, with --scheduler"
        )
    if values.get("cluster"):
        raise ConfigError(
            f"{path}: a file may not name a cluster, as the lines of its jobs are run; give it on the command "
            "line, with --cluster"
        )


def annotated_defaults() -> str:
    """Write all parameters with their defaults, meaning, unit and source as TOML."""
    return write_config(Config(), "all parameters with their defaults")


def write_config(config: Config, title: str = "the parameters of a run") -> str:
    """Write all parameters with their values, meaning, unit and source as TOML."""
    lines = [f"# citystitch configuration: {title}.", ""]
    section = ""
    for entry in dataclasses.fields(Config):
        data = entry.metadata
        if data["section"] != section:
            section = data["section"]
            lines += [f"[{section}]"]
        facts = [data["text"]]
        facts += [f"unit: {data['unit']}"] if data["unit"] else []
        facts += [f"one of: {', '.join(data['choices'])}"] if len(data["choices"]) > 1 else []
        facts += [f"({data['source']})"] if data["source"] else []
        lines += [f"# {'; '.join(facts)}", f"{entry.name} = {_toml(getattr(config, entry.name))}", ""]
    return "\n".join(lines)


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path}: is no regular file; give a configuration file")
        with path.open("rb") as file:
            content = file.read(MAX_CONFIG_BYTES + 1)
        if len(content) > MAX_CONFIG_BYTES:
            raise ConfigError(
                f"{path}: {path.stat().st_size} bytes > {MAX_CONFIG_BYTES}; this is no configuration"
            )
        return tomllib.loads(content.decode())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: its values are nested too deep; this is no configuration") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not valid TOML ({error}); see `citystitch config` for a template") from error


def _relative_to(folder: Path, name: str, value: Any) -> Any:
    if name not in (*INPUTS, *TLS, "out"):
        return value
    return change_places(name, value, lambda text: text if is_url(text) else str(folder / text))


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(value)
