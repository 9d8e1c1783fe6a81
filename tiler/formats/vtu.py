"""VTK's XML: the volume mesh as one file."""

from pathlib import Path
from typing import Any

from tiler.export.export import LARGEST_PART, Format
from tiler.mesh_files.merged import write_merged_volume
from tiler.mesh_files.run_files import RunFiles


def export_vtu(path: Path, files: RunFiles, **options: Any) -> None:
    """Write the volume of a finished run, as `tiler.mesh_files.merged.write_merged_volume` does."""
    write_merged_volume(path, files.volumes, **options)


FORMAT = Format("the volume mesh as one VTK file", export_vtu, options=("scalars", LARGEST_PART))
