"""The documentation site; `make docs` builds it into build/docs/, without a network."""

import sys
from pathlib import Path

import spotcheck

sys.path.insert(0, str(Path(__file__).parent))

project = "Spotcheck"
author = "the Spotcheck developers"
copyright = f"2026, {author}"
version = release = spotcheck.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
extensions += ["commands", "docstrings", "executed", "repository"]
exclude_patterns = ["site"]
# Pages whose code the build runs.
executed_pages = ["tutorial"]

# Anchors of headings as GitHub makes them, where the same pages are read.
myst_heading_anchors = 4
# Blocks without a language are shell lines, files and tables.
highlight_language = "none"

autodoc_member_order = "bysource"
# Units and shapes stand in the docstrings; types stand in the code.
autodoc_typehints = "none"
napoleon_google_docstring = False
napoleon_use_rtype = False
# Single backticks name something public, or are code.
default_role = "py:obj"

html_theme = "furo"
html_title = f"Spotcheck {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
