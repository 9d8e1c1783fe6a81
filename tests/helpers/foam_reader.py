"""A reader of OpenFOAM's files for tests, made from the format's description, not from what writes them."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FoamPatch:
    """An entry of the file ``boundary``."""

    kind: str
    n: int
    start: int
    groups: tuple[str, ...]
    words: dict[str, str]


@dataclass(frozen=True, eq=False)
class PolyMesh:
    """A polyMesh of triangles, as it is in the files."""

    points: Floats
    faces: Ints
    owner: Ints
    neighbour: Ints
    patches: dict[str, FoamPatch]

    @property
    def n_cells(self) -> int:
        return int(max(self.owner.max(), self.neighbour.max())) + 1

    def patch_of(self, name: str) -> slice:
        patch = self.patches[name]
        return slice(patch.start, patch.start + patch.n)


def read_poly_mesh(folder: Path) -> PolyMesh:
    """Read ``points``, ``faces``, ``owner``, ``neighbour`` and ``boundary``."""
    return PolyMesh(
        read_list(folder / "points", 3).astype(np.float64),
        read_faces(folder / "faces"),
        read_labels(folder / "owner"),
        read_labels(folder / "neighbour"),
        read_boundary(folder / "boundary"),
    )


def read_header(path: Path) -> dict[str, str]:
    """Read the entries of ``FoamFile``."""
    text = path.read_bytes()[:2000].decode("latin1")
    found = re.search(r"FoamFile\s*\{(.*?)\}", text, re.DOTALL)
    assert found, f"{path} has no head"
    return dict(
        re.findall(r'(\w+)\s+"?([^;"]*)"?;', found[1].replace("LSB;label", "LSB,label").replace(";s", ",s"))
    )


def _label(path: Path) -> np.dtype[np.signedinteger]:
    found = re.search(r"label=(\d+)", read_header(path)["arch"])
    assert found
    return np.dtype(f"<i{int(found[1]) // 8}")


def _one_list(data: bytes, at: int, dtype: np.dtype, width: int) -> tuple[NDArray, int]:  # type: ignore[type-arg]
    found = re.compile(rb"(?:\s|//[^\n]*\n)*(\d+)\s*\(").match(data, at)
    assert found, data[at : at + 40]
    count = int(found[1]) * width
    end = found.end() + count * dtype.itemsize
    assert data[end : end + 1] == b")", "a list does not end where it should"
    return np.frombuffer(data, dtype, count, found.end()).reshape(-1, width), end + 1


def _begin(path: Path) -> tuple[bytes, int]:
    data = path.read_bytes()
    return data, data.index(b"}", data.index(b"FoamFile")) + 1


def read_list(path: Path, width: int) -> NDArray:  # type: ignore[type-arg]
    """Read one binary list of vectors."""
    assert read_header(path)["format"] == "binary"
    data, at = _begin(path)
    rows, end = _one_list(data, at, np.dtype("<f8"), width)
    assert not data[end:].strip()
    return rows


def read_labels(path: Path) -> Ints:
    """Read one binary list of integers, ours or one that OpenFOAM wrote."""
    data, at = _begin(path)
    rows, end = _one_list(data, at, _label(path), 1)
    assert not re.sub(rb"//[^\n]*", b"", data[end:]).strip()
    return rows[:, 0].astype(np.int64)


def read_faces(path: Path) -> Ints:
    """Read a faceCompactList of triangles."""
    assert read_header(path)["class"] == "faceCompactList"
    data, at = _begin(path)
    start, at = _one_list(data, at, _label(path), 1)
    corners, end = _one_list(data, at, _label(path), 1)
    assert not data[end:].strip()
    assert np.array_equal(start[:, 0], 3 * np.arange(len(start)))
    assert start[-1, 0] == len(corners)
    return corners.reshape(-1, 3).astype(np.int64)


def read_boundary(path: Path) -> dict[str, FoamPatch]:
    """Read the patches."""
    text = path.read_text()
    body = text[text.index("}") + 1 :]
    found = re.search(r"(\d+)\s*\((.*)\)", body, re.DOTALL)
    assert found
    patches = {}
    for name, entries in re.findall(r"(\w+)\s*\{(.*?)\}", found[2], re.DOTALL):
        words = dict(re.findall(r"(\w+)\s+([^;]+);", entries))
        groups = re.search(r"\((.*)\)", words.get("inGroups", "()"))
        assert groups
        n, start = int(words["nFaces"]), int(words["startFace"])
        patches[name] = FoamPatch(words["type"], n, start, tuple(groups[1].split()), words)
    assert len(patches) == int(found[1])
    return patches


def read_zones(path: Path) -> dict[str, Ints]:
    """Read face zones written as text; none of their faces may be turned."""
    text = path.read_text()
    body = text[text.index("}") + 1 :]
    zones = {}
    pattern = (
        r"(\w+)\s*\{\s*type faceZone;\s*faceLabels List<label>\s*(\d+)\s*\(([\s\d]*)\)\s*;"
        r"\s*flipMap List<bool> (?:([1-9]\d*)\{0\}|0\(\));\s*\}"
    )
    for name, n, labels, n_flips in re.findall(pattern, body):
        zones[name] = np.array(labels.split(), np.int64)
        assert len(zones[name]) == int(n) == int(n_flips or 0)
    found = re.match(r"\s*(\d+)", body)
    assert found
    assert int(found[1]) == len(zones)
    return zones


def read_field(path: Path, width: int) -> Floats:
    """Read the values in cells, or on inner faces, of a binary field that is not uniform."""
    data = path.read_bytes()
    found = re.search(rb"internalField\s+nonuniform List<\w+>\s+(\d+)\s*\(", data)
    assert found, f"{path} has no values"
    values = np.frombuffer(data, "<f8", int(found[1]) * width, found.end())
    return values.reshape(-1, width)


def read_patch(path: Path, patch: str, width: int) -> Floats:
    """Read the values on a patch of a binary field that OpenFOAM wrote, where they are not uniform."""
    data = path.read_bytes()
    begin = data.index(b"\n    " + patch.encode() + b"\n", data.index(b"boundaryField"))
    found = re.compile(rb"value\s+nonuniform List<\w+>\s+(\d+)\s*\(").search(data, begin)
    assert found, f"{path}: {patch} has no values"
    return np.frombuffer(data, "<f8", int(found[1]) * width, found.end()).reshape(-1, width)
