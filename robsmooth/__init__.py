"""robsmooth: robust continuous-time fixed-lag smoothing for nonlinear uncertain systems.

A public name is imported when first asked for. `__init__.pyi` has them, each with its module. The
examples in docstrings come after ``import numpy as np`` and ``import robsmooth as rs``.
"""

import ast
import pkgutil
import sys
from importlib import import_module

_HOMES = {
    alias.name: node.module
    for node in ast.parse(pkgutil.get_data("robsmooth", "__init__.pyi")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
__all__ = sorted(_HOMES)


def __getattr__(name):
    """Import a public name; Python says which one is nearest to one that is not."""
    if name in _HOMES:
        home = import_module(_HOMES[name])
        # what its home does not hold is a module of it
        value = vars(home).get(name) or import_module(f"{_HOMES[name]}.{name}")
    elif name == "__version__":
        value = _version()
    else:
        what = f"module 'robsmooth' has no attribute {name!r}"
        raise AttributeError(what, name=name, obj=sys.modules[__name__])
    globals()[name] = value
    return value


def __dir__():
    return list(__all__)


def _version():
    from importlib import metadata

    try:
        return metadata.version("robsmooth")
    except metadata.PackageNotFoundError:  # sources that are imported where they lie
        return "0+unknown"
