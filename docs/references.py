"""Sphinx extension: what docstrings, notebooks and verdicts quote becomes a link.

The project quotes an equation of the paper by its label in the paper's source, as in "(eqbound)",
and an assumption as "Assumption 3.2": both read well in `help()`, and lead to theory.md here. A
name between single backquotes leads to its entry where it is public, and is code where it is not;
that of a page on the methods leads to the page.
"""

import inspect
import re
from collections.abc import Iterator

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util import logging
from sphinx.util.nodes import make_refnode

import robsmooth

THEORY = "theory"
METHODS = re.compile(r"docs/source/(methods|records|simulation|numerics)\.md")
QUOTED = re.compile(r"\((eq(?!u)\w+)\)|Assumptions? (\d)(?:\.\d)?")
_EQUATION = re.compile(
    r"^\((eq\w+)\)=\n\\begin\{equation\*\}.*?\\tag\{(\d+)\}", flags=re.MULTILINE | re.DOTALL
)
_CLASSES = re.compile(
    rf"\b({'|'.join(n for n in robsmooth.__all__ if inspect.isclass(getattr(robsmooth, n)))})\b"
)
_INITIAL = re.compile(r"^(\s*)(?=[A-Za-z]\.( |$))")  # or a unit: no item of a list

_log = logging.getLogger(__name__)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_post_transform(PaperReferences)
    app.connect("missing-reference", _public_name_or_code)
    app.connect("autodoc-process-docstring", _prepare, priority=400)  # before napoleon
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def equation_numbers(theory: str) -> dict[str, str]:
    """Numbers of the equations of theory.md by their labels."""
    return dict(_EQUATION.findall(theory))


class PaperReferences(SphinxPostTransform):
    """Link quoted equations and assumptions to theory.md, in the running text of every page."""

    default_priority = 5
    _left_alone = (
        *(nodes.reference, nodes.title, nodes.strong),
        *(nodes.literal, nodes.literal_block, nodes.math, nodes.math_block, nodes.raw),
    )

    def run(self, **_: object) -> None:
        """Replace the quotations of one page."""
        numbers = equation_numbers(self.env.doc2path(THEORY).read_text(encoding="utf-8"))
        for text in list(self.document.findall(nodes.Text)):
            if not isinstance(text.parent, self._left_alone) and QUOTED.search(text):
                text.parent.replace(text, list(self._parts(text, numbers)))

    def _parts(self, text: nodes.Text, numbers: dict[str, str]) -> Iterator[nodes.Node]:
        end = 0
        for found in QUOTED.finditer(text):
            yield nodes.Text(text[end : found.start()])
            yield self._link(found, numbers)
            end = found.end()
        yield nodes.Text(text[end:])

    def _link(self, found: re.Match, numbers: dict[str, str]) -> nodes.Node:
        label, assumption = found.groups()
        target = label.lower() if label else f"assumption-{assumption}"
        shown = f"({numbers.get(label)})" if label else found[0]
        page, anchor = self.env.domains.standard_domain.anonlabels.get(target, ("", ""))
        if page != THEORY:
            where = (self.env.docname, None)
            _log.warning("theory.md does not have what is quoted: %s", found[0], location=where)
            return nodes.Text(found[0])
        builder, here = self.app.builder, self.env.docname
        return make_refnode(builder, here, page, anchor, nodes.Text(shown), label)


def _public_name_or_code(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.Node | None:
    """Resolve a name between single backquotes that is not one of its own module or class."""
    if node.get("reftype") != "obj":
        return None
    if page := METHODS.fullmatch(node["reftarget"]):
        title = nodes.Text(env.titles[page[1]].astext())
        return make_refnode(app.builder, node["refdoc"], page[1], "", title)
    name = f"robsmooth.{node['reftarget'].removeprefix('rs.')}"
    entry = env.domains.python_domain.objects.get(name)
    if entry is None:
        return content
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, content, name)


def _prepare(
    app: Sphinx, what: str, name: str, member: object, options: object, lines: list[str]
) -> None:
    """Put public classes that are types between backquotes; escape what reads as a list."""
    if what in ("attribute", "property"):
        # else napoleon takes what is before a colon in the first line for the type
        lines[:0] = ["..", ""]
    section = ""
    for number, line in enumerate(lines):
        lines[number] = _INITIAL.sub(r"\1\\", line)
        if line.startswith("---"):
            section = lines[number - 1]
        elif section and line and not line[0].isspace():
            before, colon, types = line.rpartition(" : ")
            if colon or section == "Returns":
                lines[number] = before + colon + _CLASSES.sub(r"`\1`", types)
