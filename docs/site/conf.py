"""Sphinx: pages without fonts, scripts or formulas from elsewhere; every warning is an error (see build.py)."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # the extension beside this file

project = "citystitch"
copyright = "the citystitch authors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "known_names", "mathml"]
# A name that its module does not have may be of several rooms; known_names tells of those that are nowhere.
suppress_warnings = ["ref.python"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
default_role = "py:obj"  # a name in single backticks is a link where it is known
nitpicky = False

html_theme = "furo"
html_title = "citystitch"
html_static_path = [str(Path(__file__).parent / "static")]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_math_renderer = "mathml"
templates_path: list[str] = []

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_typehints = "none"  # the docstrings tell dtypes, shapes and units
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_preprocess_types = False
