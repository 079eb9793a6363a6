"""Sphinx configuration. Build with ``make docs``; warnings are errors, no network is used."""

import os
import sys
from pathlib import Path

import lbt_synth

sys.path.insert(0, str(Path(__file__).parent))
import house

os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", "error")

project = "lbt_synth"
author = "The lbt_synth developers"
copyright = author
version = release = lbt_synth.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
]
root_doc = "index"
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = [
    "_build",
    "benchmarks_table.md",
    "api/generated/modules.md",
    "gallery/sg_execution_times.rst",
]
templates_path = ["_templates"]

myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 3

autosummary_generate = True
autosummary_imported_members = False
autodoc_typehints = "none"  # the docstrings name the types and shapes
autodoc_member_order = "bysource"
numpydoc_show_class_members = False  # the templates list them
numpydoc_class_members_toctree = False

# Each build runs every script; one that fails, fails the build.
sphinx_gallery_conf = {
    "examples_dirs": "../examples/gallery",
    "gallery_dirs": "gallery",
    "image_scrapers": ("gallery_figures.save_block_figure",),
    "run_stale_examples": True,
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "min_reported_time": 1e9,
    "show_signature": False,
    "write_computation_times": False,
}

# MathJax is fetched by the reader's browser, not by the build.
html_theme = "furo"
html_title = f"lbt_synth {release}"
html_static_path = []
html_copy_source = False


def _closed_literals(app, what, name, obj, options, lines):
    """Write dots as one sign: a summary would end at them, within its literal."""
    lines[:] = [line.replace(" + ... + ", " + … + ") for line in lines]


def setup(app):
    app.connect("config-inited", lambda app, _: house.write(Path(app.srcdir) / "api"))
    app.connect("autodoc-process-docstring", _closed_literals, priority=900)
