"""Configuration of the Sphinx pages, built by `make docs`: warnings are errors, reference and pictures generated."""

import sys
from pathlib import Path

import ftlm

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

project = "ftlm"
author = "the ftlm authors"
copyright = "the ftlm authors, MIT license"
version = release = ftlm.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "formulas", "signs", "tables"]
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
root_doc = "index"
myst_heading_anchors = 3
myst_enable_extensions = ["deflist", "colon_fence", "dollarmath"]
# Quotation marks are part of arguments and equations, which readers copy.
smartquotes = False
html_math_renderer = "drawn"
# Pages link to files of the repository, which are no pages.
suppress_warnings = ["myst.xref_missing"]

autodoc_member_order = "bysource"
autodoc_typehints = "none"
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

html_theme = "pydata_sphinx_theme"
html_title = f"ftlm {release}"
html_show_sourcelink = False
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_sidebars = {"**": ["contents.html"]}
html_theme_options = {
    "navigation_with_keys": False,
    "show_prev_next": True,
    "secondary_sidebar_items": ["page-toc"],
    "navbar_center": [],
}


def setup(app: object) -> None:
    """Draw the pictures and write the pages of the reference before Sphinx reads the pages."""
    from pictures import draw  # noqa: PLC0415 — the folder is on the path only now
    from reference import write  # noqa: PLC0415

    draw(HERE / "_pictures")
    write(HERE / "_reference")
