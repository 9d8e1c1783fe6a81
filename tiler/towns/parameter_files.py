"""Parameters of houses as files: JSON, a house a line, and the XML of Random3Dcity (paper, Figure 6)."""

import json
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args, get_type_hints
from xml.sax.saxutils import escape

import shapely
from lxml import etree

from pipeline.architecture.parameters import House, Rings
from pipeline.data.errors import InputError

# What the paper's XML calls them; all others are named as here.
_NAMES = {
    **{"length": "xSize", "width": "ySize", "height": "zSize"},
    **{"storeys": "floors", "shape": "roofType", "rise": "h"},
}
XML_HEAD, XML_END = '<?xml version="1.0" encoding="UTF-8"?>\n<buildings>\n', "</buildings>\n"
_FIELDS = {name: field for field, name in _NAMES.items()}
_LISTS = {
    "parts": "buildingPart",
    "dormers": "dormer",
    "chimneys": "chimney",
    "roof_windows": "roofWindow",
    "openings": "opening",
}


def house_json(house: House) -> str:
    """Give the line of a house."""
    return json.dumps(_values_of(house), separators=(",", ":"), allow_nan=False) + "\n"


def read_json(path: Path) -> Iterator[House]:
    """Read lines of `house_json`, or what was edited in them; InputError with file and line if one is no house."""
    with path.open(encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            if line.strip():
                try:
                    yield _make(House, json.loads(line))
                except (KeyError, TypeError, ValueError) as error:
                    raise InputError(f"{path}, line {number}: is no house ({error})") from error


def read_xml(path: Path) -> Iterator[House]:
    """Read elements of `house_xml` in a file; InputError that names the house if it is no such file."""
    last = "the start"
    try:
        with path.open("rb") as file:
            for _, element in etree.iterparse(file, tag="building", resolve_entities=False, no_network=True):
                last = element.get("ID", "")
                yield _make(House, _house_values(element))
                element.clear()
    except (etree.XMLSyntaxError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}, at {last}: is no house ({error})") from error


def _make(kind: Any, values: Any) -> Any:
    """Make a data class, and those within, from what JSON gives; each value has to be of its type."""
    hints = get_type_hints(kind)
    unknown = sorted(set(values) - {field.name for field in fields(kind)})
    if unknown:
        raise ValueError(f"{kind.__name__} has no {unknown[0]!r}")
    found = {}
    for name, value in values.items():
        hint = hints[name]
        if name == "plan":
            found[name] = _read_plan(value)
        elif isinstance(value, list):
            found[name] = tuple(_make(get_args(hint)[0], item) for item in value)
        elif isinstance(value, dict):
            found[name] = _make(hint, value)
        else:
            found[name] = _take(hint, name, value)
    return kind(**found)


def _read_plan(rings: Any) -> Rings:
    """Read an outline with its courtyards; ValueError where it is none, or turns the wrong way."""
    plan = tuple(tuple((float(x), float(y)) for x, y in ring) for ring in rings)
    outline = shapely.Polygon(plan[0], plan[1:])
    if not outline.is_valid or not outline.area > 0:
        raise ValueError(f"plan: {shapely.is_valid_reason(outline)}")
    if not outline.exterior.is_ccw or any(ring.is_ccw for ring in outline.interiors):
        raise ValueError("plan: its border has to be counter-clockwise, its courtyards clockwise")
    return plan


def _take(hint: Any, name: str, value: Any) -> Any:
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    words = get_args(hint)
    if value in words if words else type(value) is hint:
        return value
    raise ValueError(f"{name} is {value!r}")


def _values_of(house: House) -> dict[str, Any]:
    """Give what `dataclasses.asdict` gives, without copies: in a tenth of the time."""
    lists = {name: [vars(one) for one in getattr(house, name)] for name in _LISTS}
    values = vars(house) | {"roof": vars(house.roof)} | lists
    if not house.plan:
        del values["plan"]
    return values


def house_xml(house: House) -> str:
    """Give the element of a house."""
    values = _values_of(house)
    x, y, z = (values.pop(name) for name in ("x", "y", "z"))
    name = values.pop("id")
    form = "Polygon" if house.plan else "Rectangular"
    rings = (" ".join(repr(value) for corner in ring for value in corner) for ring in values.pop("plan", ()))
    rows = [f"    <origin>{x!r} {y!r} {z!r}</origin>\n", *(f"    <ring>{ring}</ring>\n" for ring in rings)]
    for key, value in values.items():
        if key in _LISTS:
            rows += [f"    <{_LISTS[key]}>\n{_rows(item, 6)}    </{_LISTS[key]}>\n" for item in value]
        elif isinstance(value, dict):
            rows.append(f"    <{key}>\n{_rows(value, 6)}    </{key}>\n")
        else:
            rows.append(_row(key, value, 4))
    return f'  <building ID="{escape(name)}">\n    <footprint>{form}</footprint>\n{"".join(rows)}  </building>\n'


def _rows(values: dict[str, Any], indent: int) -> str:
    return "".join(_row(key, value, indent) for key, value in values.items())


def _row(key: str, value: Any, indent: int) -> str:
    name = _NAMES.get(key, key)
    return f"{' ' * indent}<{name}>{escape(value) if isinstance(value, str) else repr(value)}</{name}>\n"


def _house_values(element: Any) -> dict[str, Any]:
    x, y, z = map(float, element.findtext("origin").split())
    found: dict[str, Any] = {"id": element.get("ID"), "x": x, "y": y, "z": z}
    found |= {name: [] for name in _LISTS}
    lists = {tag: name for name, tag in _LISTS.items()}
    hints = get_type_hints(House)
    for child in element:
        if child.tag in ("footprint", "origin"):
            continue
        if child.tag == "ring":
            numbers = (child.text or "").split()
            found.setdefault("plan", []).append(list(zip(numbers[::2], numbers[1::2], strict=True)))
            continue
        if child.tag in lists:
            name = lists[child.tag]
            found[name].append(_values(child, get_args(hints[name])[0]))
        elif len(child):
            found[child.tag] = _values(child, hints[child.tag])
        else:
            name = _FIELDS.get(child.tag, child.tag)
            found[name] = _parse(hints[name], child.text or "")
    return found


def _values(element: Any, kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind)
    own = {field.name for field in fields(kind)}
    found = {}
    for child in element:
        name = child.tag if child.tag in own else _FIELDS[child.tag]
        found[name] = _parse(hints[name], child.text or "")
    return found


def _parse(hint: Any, text: str) -> Any:
    return hint(text) if hint in (float, int) else text
