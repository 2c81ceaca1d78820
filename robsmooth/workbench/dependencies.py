"""The modules that code depends on, found without running it.

Of `import robsmooth as rs`, `rs.NAME` counts as an import of the module of NAME alone.
"""

import ast
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from robsmooth import _HOMES

_ROOT = "robsmooth"
_ANY = ""  # stands for an import that may be of any module
_HIDING = {"__import__", "eval", "exec", "import_module"}  # what these import is not in the code


def modules_in(package: Path) -> dict[str, Path]:
    """Return the modules of the package in a folder, by name."""
    paths = {path.relative_to(package.parent): path for path in sorted(package.rglob("*.py"))}
    names = {".".join(place.with_suffix("").parts): path for place, path in paths.items()}
    return {name.removesuffix(".__init__"): path for name, path in names.items()}


def dependencies(code: str, modules: Mapping[str, Path]) -> set[str]:
    """Return the modules that code imports, itself or through others; all if it cannot be told."""
    names, found = frozenset(modules), {_ROOT}
    waiting = {*imports(code, names)} - found
    while waiting:
        name = waiting.pop()
        if name not in names:
            return {*names}
        found.add(name)
        text = modules[name].read_text(encoding="utf-8")
        waiting = (waiting | {name.rpartition(".")[0]} | imports(text, names)) - found
    return found


@cache
def imports(code: str, modules: frozenset[str]) -> frozenset[str]:
    """Return the modules of the package that code itself imports."""
    try:
        nodes = list(ast.walk(ast.parse(code)))
    except SyntaxError:  # such as a command of IPython
        return frozenset({_ANY})
    words = [node.id for node in nodes if isinstance(node, ast.Name)]
    attributes = [node for node in nodes if isinstance(node, ast.Attribute)]
    found: set[str] = set()
    roots: set[str] = set()  # names of the package in this code
    for node in nodes:
        if isinstance(node, ast.Import):
            ours = [each for each in node.names if each.name.partition(".")[0] == _ROOT]
            found |= {each.name for each in ours}
            roots |= {
                each.asname or _ROOT for each in ours if _ROOT in (each.name, each.asname or _ROOT)
            }
        elif isinstance(node, ast.ImportFrom) and str(node.module).partition(".")[0] == _ROOT:
            found |= {_home(node.module, each.name, modules) for each in node.names}
    used = [node.attr for node in attributes if getattr(node.value, "id", "") in roots]
    found |= {_home(_ROOT, name, modules) for name in used}
    handed_on = sum(word in roots for word in words) > len(used)
    hides = not _HIDING.isdisjoint([*words, *(node.attr for node in attributes)])
    return frozenset(found | {_ANY} if handed_on or hides else found)


def _home(module: str, name: str, modules: frozenset[str]) -> str:
    """Return the module that a name in a module is, or else the one that defines it."""
    inner = f"{module}.{name}"
    if inner in modules or module != _ROOT:
        return inner if inner in modules else module
    if name.startswith("_"):  # such as __version__
        return _ROOT
    return _home(_HOMES[name], name, modules) if name in _HOMES else _ANY
