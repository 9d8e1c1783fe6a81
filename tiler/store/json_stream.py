"""JSON files larger than memory, read by ijson: small members, or a large one entry by entry."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import ijson

from pipeline.data.errors import InputError

DEEPEST = 100  # levels: ours have ten at most
BUFFER = 1 << 18  # bytes that are read at once
OPTIONS = {"use_float": True, "buf_size": BUFFER}
BRACKETS = frozenset(("start_map", "start_array", "end_map", "end_array"))


def read_members(path: Path, wanted: Callable[[str], bool]) -> tuple[dict[str, Any], dict[str, str]]:
    """Read the small members of the object that a JSON file holds.

    Parameters
    ----------
    path : Path
        The file, in any layout; it is read to its end.
    wanted : callable
        Tells by its name whether an object or array is small; other values are always taken.

    Returns
    -------
    dict of str to any
        Values that were taken, as `json.loads` makes them.
    dict of str to str
        The objects and arrays that were not, ``"start_map"`` or ``"start_array"``.

    Raises
    ------
    InputError
        If the file cannot be read, is no JSON object, or nests deeper than `DEEPEST`.
    """
    taken: dict[str, Any] = {}
    large: dict[str, str] = {}
    depth, name, builder = 0, "", None
    with _opened(path) as file:
        for event, value in ijson.basic_parse(file, **OPTIONS):
            if builder is None and depth > 1 and event not in BRACKETS:  # most of what there is
                continue
            opens = event in ("start_map", "start_array")
            depth -= event in ("end_map", "end_array")
            if depth == 0 and event not in ("start_map", "end_map"):
                raise InputError(f"{path}: is no JSON object; run again")
            if depth == DEEPEST:
                raise InputError(f"{path}: nests deeper than {DEEPEST} levels; run again")
            if depth == 1 and event == "map_key":
                name, builder = value, ijson.ObjectBuilder()
            elif depth == 1 and opens and not wanted(name):
                large[name], builder = event, None
            elif depth and builder is not None:
                builder.event(event, value)
                if depth == 1 and not opens:
                    taken[name] = builder.value
            depth += opens
    return taken, large


def iterate_members(path: Path, name: str) -> Iterator[tuple[str, Any]]:
    """Read the members of a member that is an object, one at a time; InputError as from `read_members`."""
    with _opened(path) as file:
        yield from ijson.kvitems(file, name, **OPTIONS)


def iterate_elements(path: Path, name: str) -> Iterator[Any]:
    """Read the elements of a member that is an array, one at a time; InputError as from `read_members`."""
    with _opened(path) as file:
        yield from ijson.items(file, f"{name}.item", **OPTIONS)


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); run again") from error
    except (ijson.JSONError, UnicodeDecodeError) as error:
        reason = str(error).split("\n", maxsplit=1)[0]
        raise InputError(f"{path}: is no JSON ({reason}); run again") from None
