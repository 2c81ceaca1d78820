"""Sphinx configuration of the site. `docs.build` stages the sources that it reads."""

from importlib import metadata
from pathlib import Path

project = "robsmooth"
author = "the robsmooth developers"
version = release = metadata.version("robsmooth")
project_copyright = author

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",  # each entry of the reference leads to its source
    "myst_nb",
    "docs.references",
    "docs.snippets",
]
exclude_patterns = ["README.md"]  # index.md includes it
nitpicky = True
default_role = "py:obj"  # docs.references makes code of what is not public
highlight_language = "python"

# --- notebooks and Markdown ---------------------------------------------------------------------

nb_execution_mode = "off"  # they are executed by `make figures`
nb_merge_streams = True
nb_render_markdown_format = "myst"  # mathematics between dollar signs, too
nb_ipywidgets_js = {}  # by default from a network
nb_mime_priority_overrides = [("html", "application/vnd.jupyter.widget-view+json", None)]
myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "dollarmath"]
myst_heading_anchors = 3
myst_mathjax_classes = "tex2jax_process|mathjax_process|math|output_area|text_html"

# --- the API ------------------------------------------------------------------------------------

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings have shapes and units
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False
napoleon_custom_sections = [("Attributes", "params_style")]


def _say_what_is_returned(_app, what, _name, thing, _options, lines):
    """Add what a function returns, where its annotation says all."""
    returned = getattr(thing, "__annotations__", {}).get("return")
    if what not in ("function", "method") or returned is None or "Returns" in lines:
        return
    after = (i for i, line in enumerate(lines) if line in ("Raises", "See Also", "Examples"))
    at = next(after, len(lines))
    lines[at:at] = ["Returns", "-------", getattr(returned, "__name__", str(returned)), ""]


def setup(app):
    """Connect what the pages need to Sphinx."""
    app.connect("autodoc-process-docstring", _say_what_is_returned, priority=100)


# --- HTML that needs no network -----------------------------------------------------------------

html_theme = "furo"
html_title = f"robsmooth {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_search_scorer = str(Path(__file__).with_name("scorer.js"))
html_domain_indices = False
mathjax_path = "mathjax/tex-svg-full.js"  # SVG needs no fonts
mathjax3_config = {
    "tex": {"inlineMath": [["\\(", "\\)"], ["$", "$"]]},
    "svg": {"scale": 0.9},  # as large as the letters around it
}
