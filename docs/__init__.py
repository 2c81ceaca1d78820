"""The site: its Sphinx sources, and what builds it from them and from executed notebooks."""
