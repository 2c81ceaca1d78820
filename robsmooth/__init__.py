"""robsmooth: robust continuous-time fixed-lag smoothing for nonlinear uncertain systems.

A public name is imported when it is first asked for. `__init__.pyi` lists them, each with the
module that defines it.
"""

import ast
import pkgutil
from importlib import import_module

_HOMES = {
    alias.name: node.module
    for node in ast.parse(pkgutil.get_data("robsmooth", "__init__.pyi")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
__all__ = sorted(_HOMES)


def __getattr__(name):
    """Import a public name; an AttributeError says which one is nearest."""
    if name in _HOMES:
        home = import_module(_HOMES[name])
        # what its home does not hold is a module of it
        value = vars(home).get(name) or import_module(f"{_HOMES[name]}.{name}")
    elif name == "__version__":
        value = _version()
    else:
        raise AttributeError(f"module 'robsmooth' has no attribute {name!r}{_hint(name)}")
    globals()[name] = value
    return value


def __dir__():
    return list(__all__)


def _hint(name):
    import difflib

    spelled = {_key(public): public for public in __all__}
    near = [] if name.startswith("_") else difflib.get_close_matches(_key(name), spelled, n=1)
    return f"; did you mean robsmooth.{spelled[near[0]]}?" if near else ""


def _key(name):
    return name.lower().replace("_", "")


def _version():
    from importlib import metadata

    try:
        return metadata.version("robsmooth")
    except metadata.PackageNotFoundError:  # sources that are imported where they lie
        return "0+unknown"
