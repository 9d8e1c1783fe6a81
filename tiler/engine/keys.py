"""Keys: a hash of all that a result depends on, so that resume and partial rebuild are one mechanism."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from enum import Enum
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import PurePath
from typing import Any

import numpy as np

from tiler.engine.stage import WHOLE, Box, Layout, Scope, Share, Stage
from tiler.georeference.frame import AS_IT_IS, Frame
from tiler.store.store import Store

# What computes results: a change of one of their versions redoes everything.
CODE = (
    "citystitch",
    "numpy",
    "scipy",
    "shapely",
    "numba",
    "triangle",
    "pyamg",
    "laspy",
    "lazrs",
    "pyarrow",
    "pyogrio",
    "pyproj",
    "deflate",
    "lxml",
    "rasterio",
)
DIGEST = "BLAKE3"  # how contents are hashed: a result with a digest of another kind is computed anew


def stage_digest(stage: Stage, parameters: Mapping[str, Any], layout: Layout) -> bytes:
    """Hash what all items of a stage share: stage, versions of the code, declared parameters, region.

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
    parts: list[Any] = [stage.name, stage.scope.value, stage.version, code_versions(), values]
    parts += [_hex(layout.bounds), layout.identity, DIGEST]
    return _hash(json.dumps(parts, sort_keys=True).encode())


def item_key(
    shared: bytes,
    name: str,
    box: Box,
    identity: str,
    refs: Iterable[tuple[str, Iterable[tuple[str, str]]]],
    gaps: Iterable[Box] = (),
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
    gaps : iterable of tuple of float
        Boxes near it that no tile covers (m).

    Returns
    -------
    str
        32 hexadecimal digits.
    """
    parts = [name, _hex(box), identity, [[stage, list(items)] for stage, items in refs], sorted(map(_hex, gaps))]
    return _hash(shared + json.dumps(parts).encode()).hex()


@dataclasses.dataclass(frozen=True)
class OpenKey:
    """What the key of a result is made of; what a submission makes before it is left open.

    Attributes
    ----------
    shared, name, box, identity, gaps
        As for `item_key`.
    refs : dict of str to dict of str to str or None
        For each stage that is read, in a fixed order, the digest of each result by name; None where the same
        submission makes it.
    named_by : dict of str to str
        Of stages that are read, the stage whose result for the same item names what is read, where the same
        submission makes that.
    """

    shared: bytes
    name: str
    box: Box
    identity: str
    refs: dict[str, dict[str, str | None]]
    gaps: list[Box]
    named_by: dict[str, str]

    def awaited(self) -> list[tuple[str, str]]:
        """List the results that are left open, by stage and name."""
        open_refs = [
            (stage, name) for stage, items in self.refs.items() for name, digest in items.items() if digest is None
        ]
        return open_refs + [(stage, self.name) for stage in self.named_by.values()]

    def close(self, done: Mapping[tuple[str, str], Any], store: Store) -> tuple[str, dict[str, tuple[str, ...]]]:
        """Give the key, and the names of what is read by stage.

        Parameters
        ----------
        done : mapping of (str, str) to Record
            Records of all that is awaited.
        store : Store
            Has the results that one of these names.
        """
        refs: dict[str, list[tuple[str, str]]] = {}
        for stage, items in self.refs.items():
            refs[stage] = [(n, done[stage, n].digest if digest is None else digest) for n, digest in items.items()]
            if stage in self.named_by:
                names = sorted(set(done[self.named_by[stage], self.name].facts["names"]))
                refs[stage] = [(name, store.describe(stage, name)[1]) for name in names]
        key = item_key(self.shared, self.name, self.box, self.identity, refs.items(), self.gaps)
        return key, {stage: tuple(name for name, _ in items) for stage, items in refs.items()}


def declared_values(stage: Stage, parameters: Any) -> dict[str, Any]:
    """Take the declared parameters of a stage; ValueError if one is not there."""
    missing = [name for name in stage.parameters if not hasattr(parameters, name)]
    if missing:
        raise ValueError(f"stage {stage.name} declares parameters that are not there: {', '.join(missing)}")
    return {name: getattr(parameters, name) for name in sorted(stage.parameters)}


def file_identity(layout: Layout, scope: Scope, name: str) -> tuple[str, str, Frame, Share]:
    """Give path, identity, frame and share of a file item; those of none for other scopes.

    The frame is part of the identity, unless coordinates are taken as they are; so is the share, unless it is all.
    """
    if scope is not Scope.FILE:
        return "", "", AS_IT_IS, WHOLE
    item = layout.files[name]
    framed = item.identity if item.frame == AS_IT_IS else f"{item.identity} {item.frame}"
    return item.path, framed if item.share == WHOLE else f"{framed} {item.share}", item.frame, item.share


@cache
def code_versions() -> tuple[tuple[str, str], ...]:
    """Names and versions of this package and of those that it computes with, ``"unknown"`` for one without."""
    return tuple((name, version_of(name)) for name in CODE)


def version_of(name: str) -> str:
    """Version of an installed package, ``"unknown"`` for one without."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


@lru_cache(maxsize=2**16)  # those of absent tiles come again and again
def _hex(box: Box) -> tuple[str, ...]:
    return tuple(float(v).hex() for v in box)


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
