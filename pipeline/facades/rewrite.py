"""The graph rewritten: each insert becomes a pair of ConditionalLoD and InsertLoD (He et al., 4.2.1, Fig. 6)."""

from dataclasses import replace

from pipeline.facades.graph import ConditionalLod, Graph, Insert, InsertLod, Node, Repeat, Split, targets


def rewrite(graph: Graph) -> Graph:
    """Replace inserts that share all their predecessors by one ConditionalLoD that leads to an InsertLoD each.

    Notes
    -----
    What led to insert ``b`` leads to ``ConditionalLoD-k:b``: output b of the k-th group. That an insert begins a
    façade counts as a predecessor. The result is the same for each order of the nodes in the file.

    Examples
    --------
    >>> from pipeline.facades.graph import Part
    >>> nodes = {"row": Split("u", (Part(2, 0, "a"), Part(2, 0, "b"))), "a": Insert("door", 1, 2)}
    >>> made = rewrite(Graph(nodes | {"b": Insert("window", 1, 1)}, "row", "row"))
    >>> [part.to for part in made.nodes["row"].parts], made.nodes["ConditionalLoD-1"].to
    (['ConditionalLoD-1:a', 'ConditionalLoD-1:b'], ('a', 'b'))
    """
    groups: dict[tuple[str, ...], list[str]] = {}
    for name in sorted(name for name, node in graph.nodes.items() if isinstance(node, Insert)):
        before = sorted(other for other, node in graph.nodes.items() if name in targets(node))
        before += [f"={key}" for key in ("front", "other") if getattr(graph, key) == name]
        groups.setdefault(tuple(before), []).append(name)
    port: dict[str, str] = {}
    added: dict[str, Node] = {}
    for k, names in enumerate(groups.values(), start=1):
        group = f"ConditionalLoD-{k}"  # names in a file are lower case
        added[group] = ConditionalLod(tuple(names))
        port |= {name: f"{group}:{name}" for name in names}

    def lead(to: str) -> str:
        return port.get(to, to)

    made: dict[str, Node] = {}
    for name, node in graph.nodes.items():
        if isinstance(node, Split):
            made[name] = replace(node, parts=tuple(replace(part, to=lead(part.to)) for part in node.parts))
        elif isinstance(node, Repeat):
            made[name] = replace(node, to=lead(node.to))
        elif not isinstance(node, Insert):
            made[name] = node
    inserts = {name: InsertLod(node) for name, node in graph.nodes.items() if isinstance(node, Insert)}
    return Graph(made | added | inserts, lead(graph.front), lead(graph.other))
