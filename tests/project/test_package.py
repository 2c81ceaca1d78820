"""The package as a whole: its documentation, and which module may import which."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import robsmooth
from robsmooth import homodyne
from robsmooth.estimators import baselines

SOURCES = Path(robsmooth.__file__).parent
# Each module imports only from those to its left.
ORDER = """
    blas errors files progress notation tables validation steps statespace systems delay augmented
    riccati lyapunov exponential discrete records estimator smoother limit storage entropy barrier
    bound linearisation interconnection covariance analysis worst_case homodyne certificate
    baselines lag loop journal executors galerkin montecarlo nonlinear study comparison published
    provenance simulations statements reproduction report figures diagrams summaries
    explorer
""".split()  # noqa: SIM905 - one a line would be long

PUBLIC = {
    name: member
    for module in (robsmooth, baselines, homodyne)
    for name, member in vars(module).items()
    if (inspect.isclass(member) or inspect.isfunction(member))
    and not name.startswith("_")
    and member.__module__.startswith("robsmooth" if module is robsmooth else module.__name__)
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
    wanted = {"Returns"} | ({"Parameters"} if parameters(member) else set())
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


def imported_modules(path):
    """The modules of robsmooth that a source file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            names = [node.module]
            if node.module == "robsmooth":
                names = [f"robsmooth.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (n.split(".")[1] for n in names if n.startswith("robsmooth."))


@pytest.mark.parametrize("name", ORDER)
def test_imports_run_downwards_only(name):
    allowed = ORDER[: ORDER.index(name)]
    module, package = SOURCES / f"{name}.py", SOURCES / name
    if package.is_dir():
        allowed = [*allowed, name]  # the modules of a package import each other
    for path in package.glob("*.py") if package.is_dir() else [module]:
        for imported in imported_modules(path):
            assert imported in allowed, f"{path.name} imports {imported}"


def test_every_module_of_the_library_has_its_place_in_the_order():
    modules = {path.stem for path in SOURCES.glob("*.py")} - {"__init__", "cli"}
    assert modules <= set(ORDER)
