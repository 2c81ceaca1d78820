"""The notebooks as one checked run: parameters, processes, freshness, published results."""

from robsmooth._support.cluster import connect

__all__ = ["connect"]
