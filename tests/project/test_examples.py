"""The examples in docstrings run, and give what they say."""

import doctest

import pytest

from tests.helpers.public import PUBLIC

EXAMPLES = {
    found.name: found
    for name, member in PUBLIC.items()
    for found in doctest.DocTestFinder(exclude_empty=True).find(member, name, globs={})
    if found.examples
}


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_an_example_gives_what_it_says(name):
    said = []
    result = doctest.DocTestRunner().run(EXAMPLES[name], out=said.append)
    assert result.failed == 0, "".join(said)
