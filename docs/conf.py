"""The documentation site: ``make docs`` builds it into ``build/docs``, any warning an error."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

import mbn_marl  # noqa: E402 - found through the path above

project = "mbn_marl"
author = "The mbn_marl authors"
version = release = mbn_marl.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "docs.extensions.mathml",
    "docs.extensions.tables",
]
exclude_patterns = ["extensions"]

html_math_renderer = "mathml"
html_theme = "furo"
pygments_style = "friendly"  # tells added from removed lines
pygments_dark_style = "monokai"
html_title = f"mbn_marl {release}"
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_copyright = False

# Markdown
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # notebooks are kept with their outputs, which the tests reproduce

# API pages
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say what an argument is, with its shape and unit
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Faults", "Source"]

# A reference to a name of this package has to lead somewhere.
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!mbn_marl\.).*")]
