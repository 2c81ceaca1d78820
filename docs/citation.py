"""How to cite: a reference and BibTeX for the paper and the software, from CITATION.cff."""

from collections.abc import Mapping
from pathlib import Path

import yaml

# Fields of the Citation File Format that BibTeX has by the same name.
_FIELDS = ("journal", "year", "doi", "url", "version")


def page(root: Path) -> str:
    """Return the page on how to cite, in Markdown."""
    software = yaml.safe_load((root / "CITATION.cff").read_text(encoding="utf-8"))
    parts = ["# How to cite", software["message"]]
    for heading, key, work in (
        ("The paper", "rehman-petersen", software["preferred-citation"]),
        ("The software", "robsmooth", software),
    ):
        entry = f"```bibtex\n{bibtex(key, work)}\n```"
        parts += [f"## {heading}", reference(work), entry]
    parts.append("Made from [CITATION.cff](CITATION.cff), which reference managers read, too.")
    return "\n\n".join(parts) + "\n"


def reference(work: Mapping) -> str:
    """Return a work as a reference in Markdown: authors, title, and what else is known of it."""
    authors = " and ".join(
        author.get("name") or f"{author['given-names']} {author['family-names']}"
        for author in work["authors"]
    )
    rest = [
        f"version {work[name]}" if name == "version" else str(work[name]) for name in _known(work)
    ]
    return ", ".join([authors, f"*{work['title']}*", *rest]) + "."


def bibtex(key: str, work: Mapping) -> str:
    """Return the BibTeX entry of a work; one without a journal is `misc`."""
    authors = " and ".join(
        # braces keep an organisation's name from being taken apart
        f"{{{author['name']}}}"
        if "name" in author
        else f"{author['family-names']}, {author['given-names']}"
        for author in work["authors"]
    )
    fields = {"title": f"{{{work['title']}}}", "author": authors}
    fields |= {name: work[name] for name in _known(work)}
    lines = [f"  {name} = {{{value}}}," for name, value in fields.items()]
    return "\n".join([f"@{'article' if 'journal' in work else 'misc'}{{{key},", *lines, "}"])


def _known(work: Mapping) -> list[str]:
    return [name for name in _FIELDS if name in work]
