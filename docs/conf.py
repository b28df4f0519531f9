"""The documentation as a site (Sphinx): `make docs`, then open build/site/index.html.

The whole project is the source folder, so that pages link to each other and to shipped files as they do in the project.
Every warning is an error: a link or an anchor that leads nowhere, a page that nothing leads to, a docstring that can't
be read.
"""

from __future__ import annotations

import os
import sys
from importlib.metadata import version as version_of
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

project = "Decant"
author = "The Decant developers"
project_copyright = author
version = release = version_of("decant-pouring")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**.md", "configs/**.md"]
exclude_patterns = ["build", "runs", ".venv", "**/.pytest_cache", "docs/notes"]
nitpicky = False  # annotations name types of many packages; our own links are checked by MyST

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]

autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": False, "show-inheritance": False}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
add_module_names = False

html_theme = "furo"
html_title = f"Decant {version}"
if repository := os.environ.get("DECANT_REPOSITORY"):  # its address, for the link to edit a page
    html_theme_options = {"source_repository": repository, "source_branch": "main", "source_directory": ""}
html_show_sphinx = False
html_extra_path = ["site"]


def setup(app: Sphinx) -> None:
    """Bars in docstrings are magnitudes, |r − c_s|, and not substitutions."""
    app.connect("autodoc-process-docstring", _bars_as_they_are)


def _bars_as_they_are(
    _app: object, _what: str, _name: str, _object: object, _options: object, lines: list[str]
) -> None:
    lines[:] = [line.replace("|", "\\|") for line in lines]
