"""VTK's XML: the marked boundary as one file."""

from pathlib import Path
from typing import Any

from tiler.export.export import LARGEST_PART, ORIGIN, Format
from tiler.mesh_files.merged import write_merged_boundary
from tiler.mesh_files.run_files import RunFiles


def export_vtp(path: Path, files: RunFiles, **options: Any) -> None:
    """Write the boundary of a finished run, as `tiler.mesh_files.merged.write_merged_boundary` does."""
    write_merged_boundary(path, files.boundaries, files.volumes, origin=files.origin, **options)


FORMAT = Format("the marked boundary as one VTK file", export_vtp, options=("scalars", LARGEST_PART, ORIGIN))
