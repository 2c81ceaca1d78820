"""The tables of the notebooks."""

from robsmooth._support.notation import matrix
from robsmooth._support.tables import Table
from robsmooth.paper.tables import beyond, design, own, simulation

__all__ = ["Table", "beyond", "design", "matrix", "own", "simulation"]
