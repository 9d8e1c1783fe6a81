"""Rules of façades as a directed acyclic graph: splits, repeats and inserts (He et al., 4.1.3)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from typing import Any

LABELS = ("floor", "window", "door", "balcony")  # semantics of nodes


@dataclass(frozen=True)
class Part:
    """A piece of a split: `size` (m), or where that is 0 a `share` of what is left; `to`: its rule, or none."""

    size: float
    share: float
    to: str


@dataclass(frozen=True)
class Split:
    """Divides a rectangle along an axis, ``"u"`` along the wall or ``"v"`` upwards."""

    axis: str
    parts: tuple[Part, ...]
    label: str = ""


@dataclass(frozen=True)
class Repeat:
    """Divides a rectangle into equal pieces of about `size` (m); without `stretch` of just that, with a rest."""

    axis: str
    size: float
    stretch: bool
    to: str
    label: str = ""


@dataclass(frozen=True)
class Insert:
    """Puts an asset into a rectangle, in the middle of its width."""

    asset: str  #: ``"window"``, ``"door"`` or ``"balcony"``, which is its label too
    #: its size on the wall (m)
    width: float
    height: float
    sill: float = 0.0  #: its height above the lower edge of the rectangle (m)
    depth: float = 0.15  #: how deep it lies in the wall (m)
    #: number of its panes
    columns: int = 1
    rows: int = 1
    projection: float = 1.2  #: how far a balcony reaches from the wall (m)

    @property
    def label(self) -> str:
        """Its semantics."""
        return self.asset


@dataclass(frozen=True)
class ConditionalLod:
    """Evaluates how much of a product is kept, and gives it to that of `to` which its predecessor names."""

    to: tuple[str, ...]
    label: str = ""


@dataclass(frozen=True)
class InsertLod:
    """Inserts an asset in full, reduced, or flat, as the node before it says."""

    insert: Insert

    @property
    def label(self) -> str:
        """Its semantics."""
        return self.insert.asset


Node = Split | Repeat | Insert | ConditionalLod | InsertLod


@dataclass(frozen=True)
class Graph:
    """Rules by name, in an order in which each comes before those that it leads to."""

    nodes: Mapping[str, Node]  #: the rules
    #: the rule that begins the widest façade of a building, and all others; ``""`` for none
    front: str
    other: str


def targets(node: Node) -> Iterator[str]:
    """Give the names that a node leads to; ``a:b`` is output b of the node a."""
    if isinstance(node, Split):
        yield from (part.to for part in node.parts if part.to)
    elif isinstance(node, Repeat):
        yield node.to
    elif isinstance(node, ConditionalLod):
        yield from node.to


def make_graph(document: Mapping[str, Any]) -> Graph:
    """Make the graph of a document that obeys the schema.

    Raises
    ------
    ValueError
        If a node leads to one that is not there, is reached by none, or leads back to itself: with its path.

    Examples
    --------
    >>> window = {"op": "insert", "asset": "window", "width": 1.2, "height": 1.4, "sill": 0.9}
    >>> bays = {"op": "repeat", "axis": "u", "size": 2.5, "to": "window"}
    >>> list(make_graph({"front": "bays", "nodes": {"window": window, "bays": bays}}).nodes)
    ['bays', 'window']
    """
    given = {name: _make_node(fields) for name, fields in document["nodes"].items()}
    starts = {key: document.get(key, "") for key in ("front", "other")}
    led = [(f"nodes.{name}", to) for name, node in given.items() for to in targets(node)]
    for place, to in [*((key, to) for key, to in starts.items() if to), *led]:
        if to not in given:
            raise ValueError(f"{place}: leads to {to!r}, which is no node; one of {', '.join(sorted(given))}")
    if lost := [name for name in given if name not in {*starts.values(), *(to for _, to in led)}]:
        raise ValueError(f"nodes.{lost[0]}: nothing leads to it; lead to it from another node, or leave it out")
    try:
        order = list(TopologicalSorter({name: set(targets(node)) for name, node in given.items()}).static_order())
    except CycleError as error:
        circle = " -> ".join(reversed(error.args[1]))
        raise ValueError(f"nodes: {circle} is a circle; rules end at inserts, take one of these out") from None
    return Graph({name: given[name] for name in reversed(order)}, starts["front"], starts["other"])


def _make_node(fields: Mapping[str, Any]) -> Node:
    given = {key: value for key, value in fields.items() if key not in ("op", "semantics")}
    label = fields.get("semantics", "")
    if fields["op"] == "insert":
        return Insert(**given)
    if fields["op"] == "repeat":
        return Repeat(given["axis"], given["size"], given.get("stretch", True), given["to"], label)
    parts = (Part(part.get("size", 0.0), part.get("share", 0.0), part.get("to", "")) for part in given["parts"])
    return Split(given["axis"], tuple(parts), label)
