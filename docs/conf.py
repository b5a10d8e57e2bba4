"""The documentation site; `make docs` builds it into docs/_build/html."""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(1, str(Path(__file__).parents[1]))  # for the package benchmarks

import generate
from generate.address import ADDRESS
from sphinx.util import inspect
from sphinx.util.inspect import stringify_signature
from torchrl.envs import EnvBase

import torchrl_loco

project = "torchrl_loco"
author = "the torchrl_loco developers"
release = version = torchrl_loco.__version__

extensions = [
    *("myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"),
    *("sphinx.ext.mathjax", "sphinx-mathjax-offline"),  # formulas without a network
]
exclude_patterns = ["_build", "generated/fragments", "generated/notebooks/README.md"]
nitpicky = True  # a reference to a name that is gone is an error
ELSEWHERE = "gymnasium|torch|torchrl|tensordict|mujoco|mujoco_warp|warp|wp|mjw|numpy|collections|pathlib"
nitpick_ignore_regex = [("py:.*", rf"({ELSEWHERE})\..*")]
# Internal: two classes, an ImportError of files that the user has not named, and a dataclass that is made.
nitpick_ignore = [
    ("py:class", "torchrl_loco.sim.graph.ScratchPool"),
    ("py:exc", "UnnamedFileError"),
    ("py:class", "types.Sim"),
    ("py:class", "torchrl_loco.sim.buffer.Buffer"),
]

# Notebooks are shown as they are: the tests run them.
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]  # as GitHub shows them
myst_heading_anchors = 3

# The sections of an environment's docstring, as they are written in torchrl_loco/tasks.
napoleon_custom_sections = ["Observation", "Action", "Reward", "Start", "Termination", "Source"]
napoleon_numpy_docstring = False
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True

html_theme = "pydata_sphinx_theme"
html_sidebars = {
    page: [] for page in ("benchmarks", "changelog", "comparison", "fidelity", "robots")
}  # without subpages
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"torchrl_loco {release}"
html_logo = html_favicon = "_static/logo.svg"
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": "torchrl_loco"},
    "navbar_align": "left",
    "header_links_before_dropdown": 6,
    "navbar_end": ["theme-switcher", "navbar-icon-links"],
    "show_toc_level": 2,
    "navigation_depth": 3,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    **({"icon_links": [{"name": "Repository", "url": ADDRESS, "icon": "fa-brands fa-github"}]} if ADDRESS else {}),
}
copyright = "the torchrl_loco developers, Apache 2.0"

generate.everything()


def sign_environment(app, what, name, thing, options, signature, returns):
    """Returns the signature of ``__init__``, where autodoc would take that of TorchRL's metaclass."""
    if what == "class" and issubclass(thing, EnvBase):
        own = inspect.signature(thing.__init__, bound_method=True)
        return stringify_signature(own, show_return_annotation=False), returns
    return None


def from_github(app, page, source):
    """Makes a page of the site of one that GitHub shows.

    Comments that begin with ``{directive}`` are directives, what stands between ``on GitHub`` and ``end`` is left out,
    and links to notebooks point to where the site has them.
    """
    text = re.sub(r"<!-- on GitHub -->.*?<!-- end -->\n", "", source[0], flags=re.DOTALL)
    text = re.sub(r"<!-- (\{[\w-]+\}.*?)-->", r"```\1```", text, flags=re.DOTALL)
    source[0] = re.sub(r"\]\((?:\.\./)+notebooks/(\w+\.ipynb)\)", r"](/generated/notebooks/\1)", text)


def setup(app):
    """Registers what Sphinx calls."""
    app.connect("source-read", from_github)
    app.connect("autodoc-process-signature", sign_environment)
