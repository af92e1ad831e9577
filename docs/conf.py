"""The documentation site: `make docs` builds it into out/docs."""

project = "graphslam"
author = "The graphslam developers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = "graphslam"
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown"}
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
autodoc_typehints = "none"
autodoc_member_order = "bysource"
default_role = "code"
html_copy_source = False
highlight_language = "none"
templates_path: list[str] = []
