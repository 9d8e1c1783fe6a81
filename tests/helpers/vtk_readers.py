"""VTK's readers, which only print what is wrong with a file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any


def read_vtk(reader: Any, path: Path, choose: Callable[[], None] = lambda: None) -> Any:
    """Let a reader read a file, what it is to take being chosen; fails where it complains."""
    errors: list[str] = []
    for event in ("ErrorEvent", "WarningEvent"):
        reader.AddObserver(event, lambda _, name: errors.append(name))
    reader.SetFileName(str(path))
    choose()
    reader.Update()
    assert not errors
    return reader


def read_xml(path: Path) -> Any:
    """The grid of a VTP or VTU file."""
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    reader = vtkXMLPolyDataReader() if path.suffix == ".vtp" else vtkXMLUnstructuredGridReader()
    return read_vtk(reader, path).GetOutput()
