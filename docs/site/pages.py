"""Pages that are made of the code: parameters, commands, Python interface, one page a module; and of notebooks."""

import argparse
import dataclasses
import json
import os
import pkgutil
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

PACKAGES = {
    "pipeline": "the paper: pure functions on arrays, one tile, one process",
    "stitch": "what two tiles must agree on",
    "tiler": "everything with a clock, a disk or a process",
}
COLUMNS = "100"  # of the help of a command


def describe_parameters() -> str:
    """Tell every parameter of a run: default, unit, choices, meaning, source."""
    from tiler.config.config import Config

    lines = [
        "# Parameters",
        "",
        "Options of `citystitch run`, keywords of `tiler.mesh`, and keys of a configuration file are the same: "
        "`mesh_size` is `--mesh-size` on the command line.",
    ]
    section = ""
    for entry in dataclasses.fields(Config):
        data = entry.metadata
        if data["section"] != section:
            section = data["section"]
            lines += ["", f"## {section}", "", "| parameter | default | meaning |", "|---|---|---|"]
        unit = f" {data['unit']}" if data["unit"] and entry.default not in ("", ()) else ""
        default = f"`{entry.default}`{unit}" if entry.default not in ("", ()) else "none"
        told = [data["text"], f"in {data['unit']}" if data["unit"] and default == "none" else ""]
        told += [f"one of {', '.join(data['choices'])}" if len(data["choices"]) > 1 else "", data["source"]]
        meaning = "; ".join(part for part in told if part).replace("|", "\\|")
        lines.append(f"| `{entry.name}` | {default} | {meaning} |")
    return "\n".join(lines) + "\n"


def describe_commands() -> str:
    """Give the help of every command."""
    from tiler.cli.main import make_parser

    os.environ["COLUMNS"] = COLUMNS
    parser = make_parser()
    lines = ["# Command line", ""]
    for name, sub in [("citystitch", parser), *_commands(parser)]:
        lines += [f"## {name}", "", "```text", sub.format_help().rstrip(), "```", ""]
    return "\n".join(lines)


def _commands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, sub in action.choices.items():
                yield f"citystitch {name}", sub


def describe_interface() -> str:
    """List what `import tiler` gives."""
    import tiler

    lines = ["Python interface", "================", "", "What ``import tiler`` gives.", ""]
    functions = [name for name in tiler.__all__ if name[0].islower()]
    classes = [name for name in tiler.__all__ if name[0].isupper()]
    lines += [f".. autofunction:: tiler.{name}\n" for name in functions]
    for name in classes:
        options = ["   :members:", "   :special-members: __iter__, __len__"]
        lines += [f".. autoclass:: tiler.{name}", *options, ""]
    return "\n".join(lines)


def describe_modules(folder: Path) -> None:
    """Write a page for each module, and one for each package that lists them by the first line of each."""
    folder.mkdir()
    for package, what in PACKAGES.items():
        rows = [f"{package}\n{'=' * len(package)}\n\n{what[0].upper()}{what[1:]}.\n"]
        names = sorted(_modules(package))
        rows += [f":doc:`{name}`\n   {_first_line(name)}\n" for name in names]
        rows += [".. toctree::\n   :hidden:\n", *(f"   {name}" for name in names)]
        (folder / f"index-{package}.rst").write_text("\n".join(rows) + "\n")
        for name in names:
            options = "   :members:\n   :show-inheritance:\n"
            (folder / f"{name}.rst").write_text(f"{name}\n{'=' * len(name)}\n\n.. automodule:: {name}\n{options}")


def _modules(package: str) -> Iterator[str]:
    root = import_module(package)
    for found in pkgutil.walk_packages(root.__path__, f"{package}."):
        yield found.name


def _first_line(name: str) -> str:
    return (import_module(name).__doc__ or "").strip().split("\n")[0]


def convert_notebook(path: Path) -> str:
    """Write a notebook, which has no outputs, as Markdown.

    Raises
    ------
    ValueError
        If a cell is neither Markdown nor code.
    """
    notebook: dict[str, Any] = json.loads(path.read_text())
    parts = []
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
        elif cell["cell_type"] == "code":
            parts.append(f"```python\n{text}\n```")
        else:
            raise ValueError(f"{path}: a cell is {cell['cell_type']!r}, neither markdown nor code")
    return (
        "\n\n".join(parts) + f"\n\nThis page is `notebooks/{path.name}` of the repository, which the tests run.\n"
    )
