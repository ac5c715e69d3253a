"""The site: the pages of this folder, executed notebooks, and pages made of what the program says of itself.

``make docs`` builds it into ``site/``, with every warning as an error and without a network.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from make_site import docstrings, generated, mathematics

project = "SparseRob"
author = "SparseRob contributors"
html_title = "SparseRob"

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_design", "sphinx_copybutton"]
exclude_patterns = ["paper", "make_site", "figures", "**/.ipynb_checkpoints"]
source_suffix = {".md": "myst-nb"}

html_math_renderer = "mathml"
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 4
# Pages also stand on their own in the repository: they link to files and folders beside docs/.
suppress_warnings = ["myst.xref_missing", "misc.highlighting_failure"]

nb_execution_mode = "cache"
nb_execution_cache_path = str(Path(__file__).resolve().parents[1] / ".docs_cache")
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_render_markdown_format = "myst"  # what a cell shows as Markdown has tables, as the pages have
nb_merge_streams = True
nb_output_stderr = "warn"  # a cell that complains, such as an observer that is detached, fails the build

smartquotes = False  # `--option` and its quotes in the help of a command are pasted as they are read

default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True, "show-inheritance": True}

html_theme = "furo"
html_static_path = ["make_site/static"]
html_css_files = ["site.css"]
html_show_copyright = False  # LICENSE says whose it is
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0072b2", "color-brand-content": "#0072b2"},
    "dark_css_variables": {"color-brand-primary": "#56b4e9", "color-brand-content": "#56b4e9"},
}
pygments_style, pygments_dark_style = "default", "github-dark"
highlight_language = "text"  # a block that names no language is what a command printed


def setup(app: object) -> None:
    """The generated pages are written before the sources are read; docstrings are plain text, and are made safe."""
    generated.write()
    mathematics.setup(app)  # type: ignore[arg-type]
    app.connect("autodoc-process-docstring", docstrings.made_safe)  # type: ignore[attr-defined]
