"""Prepare README.md and pyproject.toml for a package index.

`python -m docs.package_page OWNER/NAME TAG` makes their links absolute. The page of the index is
not in the repository, so that relative links lead nowhere there. Only the release workflow runs
this, in its own checkout: it alone knows the address of the project.
"""

import argparse
import re
from pathlib import Path

_LINK = re.compile(r"(!?)(\[[^\]]*\]\()(?!\w+:|#)([^)\s]+\))")
_URLS = """
[project.urls]
Source = "{home}"
Documentation = "https://{owner}.github.io/{name}/"
Changelog = "{home}/blob/{tag}/CHANGELOG.md"
Issues = "{home}/issues"
"""


def absolute(text: str, repository: str, tag: str) -> str:
    """Return Markdown whose relative links and images lead to a repository at a tag."""
    pages = f"https://github.com/{repository}/blob/{tag}/"
    images = f"https://raw.githubusercontent.com/{repository}/{tag}/"

    def link(found: re.Match) -> str:
        mark, words, path = found.groups()
        return f"{mark}{words}{images if mark else pages}{path}"

    return _LINK.sub(link, text)


def urls(repository: str, tag: str) -> str:
    """Return the table of addresses for pyproject.toml."""
    owner, _, name = repository.partition("/")
    return _URLS.format(home=f"https://github.com/{repository}", owner=owner, name=name, tag=tag)


def main(arguments: list[str] | None = None) -> None:
    """Rewrite README.md and pyproject.toml of the folder that this is run in."""
    parser = argparse.ArgumentParser(prog="python -m docs.package_page", description=__doc__)
    parser.add_argument("repository", help="OWNER/NAME on GitHub")
    parser.add_argument("tag", help="such as v1.0.0; it must be v and the version")
    given = parser.parse_args(arguments)
    readme, project = Path("README.md"), Path("pyproject.toml")
    text = project.read_text(encoding="utf-8")
    version = re.search(r'^version = "(.+)"$', text, flags=re.MULTILINE)[1]
    if given.tag != f"v{version}":
        parser.error(f"tag must be v{version}, the version in pyproject.toml, got {given.tag!r}")
    if "[project.urls]" in text:
        parser.error("pyproject.toml must be that of the repository, got one with [project.urls]")
    page = absolute(readme.read_text(encoding="utf-8"), given.repository, given.tag)
    readme.write_text(page, encoding="utf-8")
    project.write_text(text + urls(given.repository, given.tag), encoding="utf-8")


if __name__ == "__main__":
    main()
