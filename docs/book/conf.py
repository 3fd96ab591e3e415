"""Sphinx's settings for the book. Sphinx builds the folder created by stage.py, never docs/ itself."""

from pygments.lexers.pascal import DelphiLexer
from sphinx.highlighting import lexers

from fieldtwin import __version__

project = "fieldtwin"
author = "the fieldtwin project"
copyright = "the fieldtwin project, Apache-2.0"
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc"]
html_theme = "furo"
html_title = f"fieldtwin {__version__}"
html_static_path = ["book.css"]
html_css_files = ["book.css"]
html_show_sphinx = False
html_last_updated_fmt = None  # the same source gives the same pages

myst_heading_anchors = 4  # like the anchors of forges: files.md#device-profile
myst_enable_extensions = ["deflist"]
suppress_warnings = ["misc.highlighting_failure"]  # examples omit text

default_role = "code"  # docstrings write `name` as Markdown does
autodoc_typehints = "signature"
autodoc_member_order = "bysource"

lexers["st"] = DelphiLexer()  # Structured Text is similar to Pascal
