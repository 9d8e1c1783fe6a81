"""Keys: a hash of all that a result depends on, so that resume and partial rebuild are one mechanism."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from enum import Enum
from importlib.metadata import PackageNotFoundError, version
from pathlib import PurePath
from typing import Any

import numpy as np

from tiler.stage import Box, Layout, Scope, Stage

DISTRIBUTION = "citystitch"


def stage_digest(stage: Stage, parameters: Mapping[str, Any], layout: Layout) -> bytes:
    """Hash what all items of a stage share: stage, package version, declared parameters, region.

    Parameters
    ----------
    stage : Stage
        The stage.
    parameters : mapping
        Values of its declared parameters.
    layout : Layout
        Its bounds and identity are taken.

    Raises
    ------
    ValueError
        If a parameter is no plain value (numbers, strings, None, and dicts, lists, tuples, dataclasses of those).
    """
    values = {}
    for name, value in parameters.items():
        try:
            values[name] = json.dumps(value, sort_keys=True, default=_plain)
        except (TypeError, ValueError) as error:
            raise ValueError(f"parameter {name} of stage {stage.name}: {error}") from error
    parts: list[Any] = [stage.name, stage.scope.value, stage.version, package_version(), values]
    parts += [[float(v).hex() for v in layout.bounds], layout.identity]
    return _hash(json.dumps(parts, sort_keys=True).encode())


def item_key(
    shared: bytes, name: str, box: Box, identity: str, refs: Iterable[tuple[str, Iterable[tuple[str, str]]]]
) -> str:
    """Hash what one result depends on.

    Parameters
    ----------
    shared : bytes
        `stage_digest` of its stage.
    name : str
        Item.
    box : tuple of float
        Its box (m).
    identity : str
        Identity of the file, for the scope FILE; else empty.
    refs : iterable
        For each stage that is read, in a fixed order, its name, and name and digest of each result, in a fixed
        order. A result that was computed anew and came out the same changes no key.

    Returns
    -------
    str
        32 hexadecimal digits.
    """
    parts = [name, [float(v).hex() for v in box], identity, [[stage, list(items)] for stage, items in refs]]
    return _hash(shared + json.dumps(parts).encode()).hex()


def declared_values(stage: Stage, parameters: Any) -> dict[str, Any]:
    """Take the declared parameters of a stage; ValueError if one is not there."""
    missing = [name for name in stage.parameters if not hasattr(parameters, name)]
    if missing:
        raise ValueError(f"stage {stage.name} declares parameters that are not there: {', '.join(missing)}")
    return {name: getattr(parameters, name) for name in sorted(stage.parameters)}


def file_identity(layout: Layout, scope: Scope, name: str) -> tuple[str, str]:
    """Give path and identity of a file item; empty for other scopes."""
    if scope is not Scope.FILE:
        return "", ""
    return layout.files[name].path, layout.files[name].identity


def package_version() -> str:
    """Version of this package, ``"unknown"`` where it is not installed."""
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return "unknown"


def _hash(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).digest()


def _plain(value: object) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} has no plain form")
