"""The examples in the docstrings: they run as they are printed, and every public name has some.

They run after the two imports that the package's docstring names. Errors and warnings have none:
what raises them has. Nor has a class of results: the function that it names in its first line has.
"""

import doctest
import importlib
import inspect
import re
from pathlib import Path

import numpy as np
import pytest

import robsmooth
from tests.helpers.public import PUBLIC

SOURCES = Path(robsmooth.__file__).parent
WITH_EXAMPLES = sorted(
    ".".join(path.relative_to(SOURCES.parent).with_suffix("").parts).removesuffix(".__init__")
    for path in SOURCES.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
# Rooms of which public names have no example yet.
MISSING = ("robsmooth._support", "robsmooth.paper")


def room(member):
    return ".".join(member.__module__.split(".")[:2])


def has_example(member):
    text = inspect.getdoc(member) or ""
    return bool(re.search(r"^Examples\n-{8}\n(.|\n)*^>>> ", text, flags=re.MULTILINE))


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_run_as_printed(module, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    here = importlib.import_module(module)
    result = doctest.testmod(here, extraglobs={"np": np, "rs": robsmooth})
    assert result.attempted > 0
    assert result.failed == 0


def is_error(member):
    return isinstance(member, type) and issubclass(member, Exception)


@pytest.mark.parametrize(
    "name",
    sorted(
        name
        for name, member in PUBLIC.items()
        if room(member) not in MISSING and not is_error(member)
    ),
)
def test_every_public_name_has_an_example(name):
    member = PUBLIC[name]
    makers = re.findall(r"`(\w+)`", inspect.getdoc(member).partition("\n")[0])
    known = [PUBLIC[each] for each in makers if each in PUBLIC and inspect.isclass(member)]
    assert any(map(has_example, [member, *known])), f"{name} has no Examples"


@pytest.mark.parametrize("missing", MISSING)
def test_a_room_that_has_all_its_examples_is_not_listed_as_missing(missing):
    assert not all(has_example(m) for m in PUBLIC.values() if room(m) == missing)


def test_the_docstring_of_the_package_names_the_imports_of_the_examples():
    assert "import numpy as np" in robsmooth.__doc__
    assert "import robsmooth as rs" in robsmooth.__doc__
