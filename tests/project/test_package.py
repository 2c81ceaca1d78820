"""The package as a whole: its documentation, and which module may import which."""

import ast
import inspect
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import robsmooth
from tests.helpers.public import PUBLIC

SOURCES = Path(robsmooth.__file__).parent
# A room is a folder. It imports from rooms of lower floors only.
FLOORS = {
    "robsmooth": 8,
    "robsmooth.explorer": 8,
    "robsmooth.paper": 7,
    "robsmooth.paper.figures": 7,
    "robsmooth.homodyne": 6,
    "robsmooth.homodyne.montecarlo": 6,
    "robsmooth.analysis": 5,
    "robsmooth.io": 5,
    "robsmooth.simulation": 5,
    "robsmooth.estimators": 4,
    "robsmooth._numerics": 2,
    "robsmooth.systems": 3,
    "robsmooth.workbench": 2,
    "robsmooth._support": 1,
}


def sections(member):
    """The headings of a numpydoc docstring."""
    return re.findall(r"^(\w[\w ]*)\n-+$", inspect.getdoc(member) or "", flags=re.MULTILINE)


def documented(member, section):
    """The names that a section documents."""
    body = re.split(rf"^{section}\n-+\n", inspect.getdoc(member), flags=re.MULTILINE)[1]
    body = re.split(r"^\w[\w ]*\n-+$", body, flags=re.MULTILINE)[0]
    lines = re.findall(r"^(\S[^:\n]*)", body, flags=re.MULTILINE)
    return [name.strip("* ") for line in lines for name in line.split(",")]


def parameters(function):
    return [name for name in inspect.signature(function).parameters if name != "self"]


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_every_public_name_has_a_numpydoc_docstring(name):
    member = PUBLIC[name]
    assert inspect.getdoc(member), f"{name} has no docstring"
    first = inspect.getdoc(member).splitlines()[0]
    assert first.endswith((".", ":")), f"the first line of {name} is not a sentence: {first!r}"
    found = sections(member)
    if inspect.isclass(member):
        if issubclass(member, Exception) and "__init__" not in vars(member):
            return  # an error with a message only
        assert {"Parameters", "Attributes"} & set(found), f"{name} says nothing of its fields"
        return
    returned = inspect.signature(member).return_annotation
    # a class says itself what it has
    is_told = (
        returned is None
        or isinstance(returned, str)
        or hasattr(robsmooth, getattr(returned, "__name__", ""))
    )
    wanted = set() if is_told else {"Returns"}
    wanted |= {"Parameters"} if parameters(member) else set()
    assert wanted <= set(found), f"{name} lacks {wanted - set(found)}"
    if "Parameters" in wanted:
        assert documented(member, "Parameters") == parameters(member)


@pytest.mark.parametrize(
    "name", sorted(n for n, m in PUBLIC.items() if hasattr(m, "__dataclass_fields__"))
)
def test_every_field_of_a_public_class_is_documented(name):
    member = PUBLIC[name]
    fields = list(member.__dataclass_fields__)
    of_the_base = getattr(member.__base__, "__dataclass_fields__", {})
    section = "Attributes" if "Attributes" in sections(member) else "Parameters"
    documented_names = documented(member, section)
    for field in fields:
        assert field in documented_names or field in of_the_base, f"{name}.{field}"


MODULES = {
    ".".join(path.relative_to(SOURCES.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in SOURCES.rglob("*.py")
}


def room(module):
    """The folder that a module stands in; that of a folder's face is the folder."""
    return module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]


def imported_modules(module):
    """The modules of robsmooth that a module imports, now or when a function of it is called."""
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} has a relative import"
            full = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else node.module for name in full]
        else:
            continue
        yield from (name for name in names if name.partition(".")[0] == "robsmooth")


def imported_rooms(name):
    """What the modules of a room import from other rooms: pairs of a module and an imported one."""
    inside = [module for module in MODULES if room(module) == name]
    pairs = [(module, other) for module in inside for other in imported_modules(module)]
    return [(module, other) for module, other in pairs if room(other) != name]


def test_every_folder_is_a_room_with_a_floor():
    assert {room(module) for module in MODULES} == set(FLOORS)


@pytest.mark.parametrize("name", FLOORS)
def test_a_room_imports_from_lower_floors_only(name):
    for module, other in imported_rooms(name):
        inside_the_same = other.startswith(f"{name}.") or name.startswith(f"{room(other)}.")
        assert inside_the_same or FLOORS[room(other)] < FLOORS[name], f"{module} imports {other}"


def test_modules_do_not_import_each_other_in_a_circle():
    tuple(TopologicalSorter({m: set(imported_modules(m)) for m in MODULES}).static_order())
