"""The documentation site: `make docs` makes docs/_build/html from Markdown, the notebooks and the docstrings.

Snippets of the pages are run by tests/docs/test_pages.py, each page by itself, from beginning to end:

* ```` ```python ````: the blocks of a page are one program.
* ```` ```console ````: each line that begins with ``$ aacmm`` is run in a temporary folder that contains `examples`;
  the lines after it show what it prints, and are compared on the pages that the test names. After a line
  ``$ cd examples/NAME``, the folder contains the files of that example, too.
* ```` ```toml ```` after a line ``<!-- file: name.toml -->``: written to that file of the temporary folder first.
* ```` ```text ````, ```` ```bash ````, other ```` ```toml ````, and any block after a line
  ``<!-- not run: reason -->``: not run.

`make docs NOTEBOOKS=stored` shows the outputs that the notebooks are stored with, and runs none.
"""

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "extensions"))

project = "aacmm_jax"
author = copyright = "The aacmm_jax developers"
html_title = "aacmm_jax"

extensions = [
    "myst_nb",
    "sphinx_copybutton",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "mathml",
    "source_links",
    "class_fields",
    "api_pages",
    "signatures",
    "command_pages",
    "file_pages",
    "gallery",
    "accessible",
    "glossary_links",
    "llms",
]
exclude_patterns = ["_build", "notebooks/README.md"]
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]  # types of other packages, and code in docstrings that is no reference
html_theme = "furo"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_theme_options = {"light_logo": "logo.svg", "dark_logo": "logo.svg"}
html_favicon = "static/logo.svg"
html_search_scorer = str(HERE / "search_scorer.js")
pygments_dark_style = "github-dark"
copybutton_prompt_text = "$ "  # of console blocks the commands are copied, and not what they print
copybutton_line_continuation_character = "\\"
html_copy_source = False
html_show_search_summary = False  # would be fetched, which a page on a disk may not do
toc_object_entries = False

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 4

# The notebooks stay where they are; see `api_pages.link_notebooks`.
nb_execution_mode = "off" if os.environ.get("NOTEBOOKS") == "stored" else "cache"
nb_execution_cache_path = str(HERE / "_build" / "notebooks")
nb_execution_timeout = 1800
nb_execution_raise_on_error = True
nb_ipywidgets_js = {}  # would be loaded over a network

default_role = "py:obj"
autodoc_inherit_docstrings = False  # of other packages
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 100
