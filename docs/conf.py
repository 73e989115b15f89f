"""Sphinx configuration; build with ``python -m sphinx -W -b html docs docs/_build/html`` after ``pip install ".[docs]"``."""

from __future__ import annotations

import sys
from pathlib import Path

from sphinx.application import Sphinx

import naibu

sys.path.insert(0, str(Path(__file__).resolve().parent / "_ext"))

project = "naibu"
author = "The naibu developers"
copyright = author
release = version = naibu.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "sphinx.ext.mathjax",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinxcontrib.bibtex",
    "accessibility",
    "benchmark_plots",
    "benchmark_results",
    "naibu_help",
    "open_branch",
    "public_names",
]
bibtex_bibfiles = ["references.bib"]
bibtex_reference_style = "author_year"
bibtex_default_style = "plain"
default_role = "py:obj"
exclude_patterns = ["_build", "_templates", "gallery_src", "tutorials_src", "sg_execution_times.rst"]
templates_path = ["_templates"]

autosummary_generate = True
autodoc_mock_imports = ["warp"]  # an extra
autodoc_typehints = "none"  # types stand in the numpydoc sections
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

sphinx_gallery_conf = {
    "examples_dirs": ["gallery_src", "tutorials_src"],
    "gallery_dirs": ["gallery", "tutorials"],
    "thumbnail_size": (480, 336),
    "filename_pattern": r"plot_",
    "within_subsection_order": "ExampleTitleSortKey",
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "min_reported_time": 5,
    "abort_on_example_error": True,
    "capture_repr": (),
}

toc_object_entries = False

html_theme = "furo"
html_title = f"naibu {release}"
html_static_path = ["_static"]
html_css_files = ["naibu.css"]
html_theme_options = {
    "sidebar_hide_name": False,
    "light_css_variables": {"color-brand-primary": "#0b5c8f", "color-brand-content": "#0b5c8f"},
    "dark_css_variables": {"color-brand-primary": "#7cc0ee", "color-brand-content": "#7cc0ee"},
}
copybutton_prompt_text = "$ "


def only_our_own(app: Sphinx, what: str, name: str, member: object, skip: bool, options: object) -> bool | None:
    """Leave out what a module merely imports, and fields whose docstring Python wrote: they are told under "Attributes"."""
    foreign = what == "module" and not str(getattr(member, "__module__", "naibu")).startswith("naibu")
    written_by_python = (getattr(member, "__doc__", "") or "").startswith("Alias for field number")
    return True if foreign or written_by_python else None


def setup(app: Sphinx) -> None:
    app.connect("autodoc-skip-member", only_our_own)
