"""The documentation site: Sphinx with the theme that numpy, scipy and python-control's readers know."""

from __future__ import annotations

import gc
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import obsynth

HERE = Path(__file__).parent
# A build keeps nearly all it makes: a tenth of its time went to looking for what it does not.
gc.freeze()
gc.set_threshold(100_000, 20, 20)
sys.path[:0] = [str(HERE), str(HERE / "_ext")]
from site_sources import write_sources  # noqa: E402

project = "obsynth"
author = "the obsynth developers"
copyright = f"2026, {author}"
release = version = obsynth.__version__

extensions = [
    "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.mathjax", "numpydoc", "myst_nb", "sphinx_design",
    "sphinx_copybutton", "matplotlib.sphinxext.plot_directive", "sphinx_gallery.gen_gallery", "shown",
]  # fmt: skip
#: Where the code is: the one place that names it.
REPOSITORY = "https://example.org/obsynth"
exclude_patterns = [
    "_build",
    "_ext",
    "gallery",
    "made/gallery/*.ipynb",
    "**.ipynb_checkpoints",
    "site_sources.py",
    "make_picture.py",
]
myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"
# The order of the gallery is a function, which Sphinx cannot keep between builds.
suppress_warnings = ["myst.header", "config.cache"]
#: From what everybody draws first to what few need.
PICTURES = (
    "simulation", "data", "faults", "states", "parameters", "residuals", "detection", "decision", "compare", "trade_off",
    "delays", "gains", "poles", "least_thresholds", "intervals", "hidden_course", "tolerances",
)  # fmt: skip
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "made/gallery",
    "within_subsection_order": lambda name: PICTURES.index(name.removeprefix("plot_").removesuffix(".py")),
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
    "write_computation_times": False,
    "min_reported_time": 5,
    "show_signature": False,
    "image_scrapers": ("matplotlib",),
    "reset_modules": (),
    "capture_repr": (),
}

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
html_title = f"obsynth {version}"
html_favicon = "_static/logo.svg"
html_theme_options = {
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "logo": {"text": html_title, "image_light": "_static/logo.svg", "image_dark": "_static/logo.svg"},
    "icon_links": [{"name": "Repository", "url": REPOSITORY, "icon": "fa-solid fa-code-branch"}],
    "navbar_end": ["theme-switcher", "navbar-icon-links"],
}
html_static_path = ["_static"]
html_css_files = ["site.css"]
# These pages have nothing beside or below them that a left column could list.
html_sidebars: dict[str, list[str]] = {
    "*": [],
    "made/gallery/*": [],
    "made/spec": [],
    "made/commands": [],
    "made/changelog": [],
}
html_show_sourcelink = False

write_sources(HERE)
# Formulas are drawn by a copy of MathJax in the site, so that they appear without a network.
mathjax = find_spec("sphinx-mathjax-offline")
if mathjax is None or mathjax.origin is None:
    raise ImportError("sphinx-mathjax-offline is missing: pip install '.[docs]'")
(HERE / "made/static").mkdir()
shutil.copy(Path(mathjax.origin).parent / "static/mathjax/tex-svg.js", HERE / "made/static/mathjax.js")
html_static_path.append("made/static")
mathjax_path = "mathjax.js"
myst_update_mathjax = False
