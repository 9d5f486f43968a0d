"""How Sphinx builds this folder: `make docs`."""

import importlib.metadata
import pathlib
import sys
import tomllib

HERE = pathlib.Path(__file__).parent
sys.path.insert(0, str(HERE / "extensions"))
project_file = tomllib.loads((HERE.parent / "pyproject.toml").read_text("utf-8"))
home = project_file["tool"]["hatch"]["metadata"]["hooks"]["custom"]["home"]

project = "Credo"
author = "The Credo authors"
release = importlib.metadata.version("credo")
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx_design",
    "generated_pages",
    "markdown_docstrings",
]
exclude_patterns = ["extensions"]

myst_enable_extensions = ["deflist", "colon_fence"]
myst_heading_anchors = 3
autodoc_typehints = "none"  # shapes and types stand in the text
autodoc_member_order = "bysource"
highlight_language = "text"  # commands and what they print, unless a block says python

html_theme = "furo"
html_title = "Credo"
html_copy_source = False
html_show_copyright = False
html_static_path = ["static"]
html_css_files = ["site.css"]
html_js_files = ["claims.js"]
if home:
    html_theme_options = {
        "source_repository": home,
        "source_branch": "main",
        "source_directory": "docs/",
    }
