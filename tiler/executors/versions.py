"""Versions of all that decides the bytes of a result, in this process or in one elsewhere.

The text of this file is also run in the processes of a cluster, which may have another Python and no citystitch at
all: it imports nothing but the standard library, and what it looks at.
"""

import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import pathlib
import sys

MISSING = "missing"
OURS = ("pipeline", "stitch", "tiler")  # the packages of citystitch, whose sources count
TRANSPORT = ("dask", "distributed")  # what carries tasks
LIBRARIES = (
    *("blake3", "deflate", "laspy", "lazrs", "lxml", "numba", "numcodecs", "numpy", "pyamg", "pyarrow", "pyogrio"),
    *("pyproj", "rasterio", "scipy", "shapely", "triangle", "zarr"),
)
NATIVE = {  # libraries within those, by the module and the attribute that tell
    "GDAL": ("pyogrio", "__gdal_version_string__"),
    "GEOS": ("shapely", "geos_version_string"),
    "PROJ": ("pyproj", "proj_version_str"),
}


def describe_versions(only: "tuple[str, ...] | None" = None) -> "dict[str, str]":
    """Versions by name, in this process; `MISSING` for what is not installed.

    Parameters
    ----------
    only : tuple of str, optional
        Those to look at besides Python and citystitch; all by default.

    Notes
    -----
    Of Python major and minor version count. Of citystitch the sources count, as 8 hexadecimal digits of a hash:
    two states between two releases have one version.
    """
    found = {"python": f"{sys.version_info[0]}.{sys.version_info[1]}", "citystitch": _describe_ours()}
    for name in (*TRANSPORT, *LIBRARIES) if only is None else only:
        found[name] = _describe_library(name)
    for name, (module, attribute) in NATIVE.items() if only is None else ():
        try:
            found[name] = str(getattr(importlib.import_module(module), attribute))
        except Exception:  # whatever a broken library raises
            found[name] = MISSING
    return found


def digest_versions(versions: "dict[str, str]") -> str:
    """Hash versions: 16 hexadecimal digits."""
    return hashlib.blake2b(json.dumps(versions, sort_keys=True).encode(), digest_size=8).hexdigest()


def _describe_library(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return MISSING


def _describe_ours() -> str:
    """A hash of the sources of citystitch, installed or not."""
    hashed = hashlib.blake2b(digest_size=4)
    for package in OURS:
        try:
            spec = importlib.util.find_spec(package)
        except (ImportError, ValueError):
            spec = None
        if spec is None or not spec.submodule_search_locations:
            return MISSING
        root = pathlib.Path(next(iter(spec.submodule_search_locations)))
        for path in sorted(root.rglob("*.py"), key=lambda path: path.relative_to(root).parts):
            name = "/".join((package, *path.relative_to(root).parts))
            hashed.update(f"{name}\0".encode() + path.read_bytes() + b"\0")
    return f"sources {hashed.hexdigest()}"
