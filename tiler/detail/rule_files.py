"""Files of rules of façades, JSON or TOML: those of the package and others, held against their JSON schema."""

import json
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError
from pipeline.facades.facade import has_room
from pipeline.facades.graph import Graph, Insert, make_graph
from pipeline.facades.rewrite import rewrite
from tiler.detail import RULES
from tiler.towns.rule_files import read_rules

HERE = Path(__file__).parent


def rule_schema() -> dict[str, Any]:
    """Give the JSON schema (draft 2020-12) of a file of rules."""
    schema: dict[str, Any] = json.loads((HERE / "rules.schema.json").read_text(encoding="utf-8"))
    return schema


def load_graph(rules: str) -> Graph:
    """Read rules, one of `RULES` or a file, and rewrite their graph for levels of detail.

    Raises
    ------
    ConfigError
        If the file cannot be read or breaks the schema; if a node leads nowhere or back to itself; if an asset has
        no room for its panes: with the path of the node.
    """
    import jsonschema

    path = HERE / f"{rules}.json" if rules in RULES else Path(rules)
    if not path.is_file():
        raise ConfigError(f"--rules {rules}: no such file; give one, or {', '.join(RULES)}")
    document = read_rules(path)
    faults = jsonschema.Draft202012Validator(rule_schema()).iter_errors(document)
    fault = jsonschema.exceptions.best_match(faults)
    if fault is not None:
        place = ".".join(map(str, fault.absolute_path)) or "the table"
        raise ConfigError(f"{path}: {place}: {_say(fault)}; see docs/facade-rules.md")
    try:
        json.dumps(document, allow_nan=False)
    except ValueError as error:
        raise ConfigError(f"{path}: a number is NaN; give one within the bounds of the schema") from error
    try:
        graph = make_graph(document)
        for name, node in graph.nodes.items():
            if isinstance(node, Insert) and not has_room(node):
                size, panes = f"{node.width:g} by {node.height:g} m", f"{node.columns} by {node.rows} panes"
                raise ValueError(f"nodes.{name}: {size} has no room for {panes}; enlarge it, or take fewer panes")
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    return rewrite(graph)


def _say(fault: Any) -> str:
    """Say what is wrong with a value, and its bound."""
    if fault.validator in ("anyOf", "oneOf"):
        names = " or ".join(name for one in fault.validator_value for name in one["required"])
        return f"has {', '.join(fault.instance) or 'nothing'}; give {names}"
    text: str = fault.message
    return text
