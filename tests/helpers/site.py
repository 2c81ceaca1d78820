"""What a page of the site holds, for the tests of the site."""

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "object": "data"}
OF_A_BROWSER = {"stylesheet", "icon", "preload", "prefetch", "modulepreload"}


class Page(HTMLParser):
    """A page, read: anchors, links, what a browser loads with it, texts of images, words."""

    def __init__(self, path):
        super().__init__()
        self.path = path
        self.anchors, self.links, self.loaded, self.words = [], [], [], []
        self.images = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if "id" in attributes:
            self.anchors.append(attributes["id"])
        if tag == "img":
            self.images.append((attributes["src"], attributes.get("alt", "")))
        if tag == "a" and "href" in attributes:
            self.links.append(attributes["href"])
        if tag == "link" and OF_A_BROWSER & set(attributes["rel"].split()):
            self.loaded.append(attributes["href"])
        if LOADED.get(tag) in attributes:
            self.loaded.append(attributes[LOADED[tag]])

    def handle_data(self, data):
        self.words.append(data)

    def target(self, address):
        """The file and the anchor that an address on this page leads to."""
        parts = urlsplit(address)
        path = (self.path.parent / unquote(parts.path)).resolve() if parts.path else self.path
        return path, unquote(parts.fragment)


def read_pages(site: Path) -> dict[str, Page]:
    """Read all pages of a site, by their paths in it."""
    site = site.resolve()
    return {path.relative_to(site).as_posix(): Page(path) for path in sorted(site.rglob("*.html"))}
