"""Files of rules for towns: TOML or JSON, and their JSON schema."""

import json
import tomllib
from pathlib import Path
from typing import Any

from pipeline.architecture.rules import PRESETS, SIZES, WORDS
from pipeline.data.errors import ConfigError

LARGEST = 1 << 20  # bytes of a file of rules


def read_rules(path: Path) -> dict[str, Any]:
    """Read a file of rules, a table by the name of each rule; ConfigError if it cannot be read, or holds no table.

    See `pipeline.architecture.rules.make_rules`.
    """
    try:
        if path.stat().st_size > LARGEST:
            raise ConfigError(f"{path}: has more than {LARGEST} bytes; a file of rules has some hundred")
        text = path.read_text(encoding="utf-8")
        rules = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); rules are TOML, or JSON if so named") from error
    if not isinstance(rules, dict):
        raise ConfigError(f"{path}: holds no table of rules")
    return rules


def rule_schema() -> dict[str, Any]:
    """Give the JSON schema (draft 2020-12) of a file of rules."""
    properties: dict[str, Any] = {}
    for name in PRESETS["detached"]:
        value: dict[str, Any] = (
            {"type": "number", "minimum": SIZES[name][0], "maximum": SIZES[name][1]}
            if name in SIZES
            else {"enum": list(WORDS[name] or ())}
            if WORDS[name]
            else {"type": "string"}
        )
        choice = {
            "type": "object",
            "properties": {
                "choice": {"type": "array", "items": value, "minItems": 1},
                "weights": {"type": "array", "items": {"type": "number", "minimum": 0}},
            },
            "required": ["choice"],
            "additionalProperties": False,
        }
        drawn = [
            _numbers({"uniform": (value, 2)}),
            _numbers({"normal": ({"type": "number"}, 2), "within": (value, 2)}),
        ]
        properties[name] = {"anyOf": [value, choice, *(drawn if name in SIZES else [])]}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Rules that houses of a synthetic town are drawn by",
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
    }


def _numbers(rows: dict[str, tuple[dict[str, Any], int]]) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": {
            name: {"type": "array", "items": item, "minItems": n, "maxItems": n}
            for name, (item, n) in rows.items()
        },
        "required": list(rows),
        "additionalProperties": False,
    }
