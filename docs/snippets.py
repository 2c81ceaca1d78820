"""Sphinx extension: the search shows where a page has the words, on a site without a server.

Sphinx's search fetches each page that it has found, which a browser refuses for files. A script of
all pages' text, which the search page alone loads, answers in the server's place.
"""

import json
import re
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx

_SCRIPT = "texts.js"
_ANSWER = """
window.fetch = async address => {
    const page = document.createElement("div");
    page.setAttribute("role", "main");
    page.textContent = TEXTS[address.replace(/^([.]\\/)*|[.]html$/g, "")] ?? "";
    return {text: async () => page.outerHTML};
};
"""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.connect("html-page-context", _load)
    app.connect("build-finished", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _load(app: Sphinx, page: str, *_: object) -> None:
    if page == "search":
        app.add_js_file(_SCRIPT)


def _write(app: Sphinx, failure: Exception | None) -> None:
    if failure is None:
        texts = {page: _text(app.env.get_doctree(page)) for page in app.env.all_docs}
        script = f"const TEXTS = {json.dumps(texts, sort_keys=True)};{_ANSWER}"
        Path(app.outdir, "_static", _SCRIPT).write_text(script, encoding="utf-8")


def _text(page: nodes.document) -> str:
    """Return what can be read of a page, without formulas and HTML."""
    unread = nodes.raw, nodes.math, nodes.math_block, nodes.comment
    words = (word for word in page.findall(nodes.Text) if not isinstance(word.parent, unread))
    return re.sub(r" (?=[.,;:)])", "", " ".join(" ".join(words).split()))
