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
    paths = {path.relative_to(package.parent): path for path in package.rglob("*.py")}
    names = {".".join(place.with_suffix("").parts): path for place, path in paths.items()}
    return {name.removesuffix(".__init__"): path for name, path in names.items()}


def dependencies(code: str, modules: Mapping[str, Path]) -> set[str]:
    """Return the modules that code imports, itself or through others; all if it cannot be told."""
    names, found = frozenset(modules), {_ROOT}
    waiting = {*_imports(code, names)} - found
    while waiting:
        name = waiting.pop()
        if name not in names:
            return {*names}
        found.add(name)
        text = modules[name].read_text(encoding="utf-8")
        waiting = (waiting | {name.rpartition(".")[0]} | _imports(text, names)) - found
    return found


@cache
def _imports(code: str, modules: frozenset[str]) -> set[str]:
    """Return the modules of the package that code itself imports."""
    try:
        nodes = list(ast.walk(ast.parse(code)))
    except Exception:  # not Python, such as a command of IPython
        return {_ANY}
    attributes = [node for node in nodes if isinstance(node, ast.Attribute)]
    words = [node.id for node in nodes if isinstance(node, ast.Name)]
    aliases = [each for node in nodes if isinstance(node, ast.Import) for each in node.names]
    ours = [each for each in aliases if each.name.partition(".")[0] == _ROOT]
    roots = {each.asname or _ROOT for each in ours if each.name == _ROOT or not each.asname}
    members = [(_ROOT, a.attr) for a in attributes if getattr(a.value, "id", "") in roots]
    handed_on = sum(word in roots for word in words) > len(members)
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and str(node.module).partition(".")[0] == _ROOT:
            members += [(node.module, each.name) for each in node.names]
    found = {_home(*member, modules) for member in members} | {each.name for each in ours}
    hides = not _HIDING.isdisjoint([*words, *(each.attr for each in attributes)])
    return found | {_ANY} if handed_on or hides else found


def _home(module: str, name: str, modules: frozenset[str]) -> str:
    """Return the module that a name in a module is, or else the one that defines it."""
    if module == _ROOT and f"{_ROOT}.{name}" not in modules:
        module = _HOMES.get(name, _ROOT if name.startswith("_") else _ANY)  # such as __version__
    inner = f"{module}.{name}"
    return inner if inner in modules else module
