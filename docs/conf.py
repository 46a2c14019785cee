"""The documentation site: Sphinx with the theme that numpy, scipy and python-control's readers know."""

from __future__ import annotations

import sys
from pathlib import Path

import obsynth

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
from site_sources import write_sources  # noqa: E402

project = "obsynth"
author = "the obsynth developers"
copyright = f"2026, {author}"
release = version = obsynth.__version__

extensions = [
    "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.mathjax", "numpydoc", "myst_nb", "sphinx_design",
    "sphinx_copybutton", "matplotlib.sphinxext.plot_directive",
]  # fmt: skip
exclude_patterns = ["_build", "**.ipynb_checkpoints", "site_sources.py", "make_picture.py"]
myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"
suppress_warnings = ["myst.header"]

templates_path = ["_templates"]
autosummary_generate = True
autodoc_typehints = "none"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False
plot_html_show_formats = False
plot_html_show_source_link = False
plot_include_source = True
plot_formats = [("png", 110)]
plot_basedir = str(HERE)
plot_working_directory = str(HERE.parent)
linkcheck_ignore = [r"https?://localhost.*"]

html_theme = "pydata_sphinx_theme"
html_title = "obsynth"
html_theme_options = {"show_toc_level": 2, "navigation_with_keys": False, "secondary_sidebar_items": ["page-toc"]}
html_static_path = ["_static"]
html_css_files = ["site.css"]
# These pages have nothing beside or below them that a left column could list.
html_sidebars: dict[str, list[str]] = {"*": [], "gallery/*": []}
html_show_sourcelink = False

write_sources(HERE)
