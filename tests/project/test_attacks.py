"""`make attack` finds the scripts by itself, and tells of every failure."""

import pytest

from tests.attacks import __main__ as attacks

GOOD = "print('a: 3 tries, 0 failures (3 refused)')\nprint('b, at c: 2 tries, 0 failures')\n"
ASKED = "import sys\nprint(f'{sys.argv[1:]}: 1 tries, 0 failures')\n"


@pytest.fixture
def scripts(tmp_path, monkeypatch):
    """Write scripts by their names, instead of those of the project."""
    folder = tmp_path / "tests" / "attacks"
    folder.mkdir(parents=True)
    monkeypatch.setattr(attacks, "FOLDER", folder)

    def write(**codes):
        for name, code in codes.items():
            (folder / f"{name}.py").write_text(code)

    return write


def rows(capsys):
    """The rows of the table, without the seconds."""
    text = capsys.readouterr().out.rpartition("\n\n")[2]
    return [line.rsplit(maxsplit=1)[0].split() for line in text.splitlines()]


def test_each_script_is_run_and_every_attack_has_a_row(scripts, capsys):
    scripts(good=GOOD, other=ASKED, __main__="raise SystemExit(5)")
    assert attacks.main(["--tries", "7"]) == 0
    assert rows(capsys) == [
        ["attack", "tries", "failures"],
        ["good:", "a", "3", "0"],
        ["good:", "b,", "at", "c", "2", "0"],
        ["other:", "['--tries=7']", "1", "0"],
    ]


@pytest.mark.parametrize(
    "code, row",
    [
        ("print('a: 3 tries, 1 failures')", ["bad:", "a", "3", "1"]),
        (f"{GOOD}raise SystemExit(1)", ["bad", "exit", "code", "1"]),
        ("print('nothing tried')", ["bad", "exit", "code", "0"]),
        ("import os\nos.kill(os.getpid(), 9)", ["bad", "exit", "code", "-9"]),
    ],
)
def test_a_script_that_fails_or_tells_of_no_try_is_a_failure(scripts, capsys, code, row):
    scripts(bad=code, good=GOOD)
    assert attacks.main([]) == 1
    found = rows(capsys)
    assert row in found
    assert ["good:", "a", "3", "0"] in found, "the others run all the same"


def test_some_can_be_asked_for(scripts, capsys):
    scripts(good=GOOD, other=ASKED)
    assert attacks.main(["--only", "oth"]) == 0
    assert rows(capsys)[1:] == [["other:", "[]", "1", "0"]]
    with pytest.raises(SystemExit):
        attacks.main(["--only", "nothing"])
    assert "no script of attacks/ has 'nothing' in its name" in capsys.readouterr().err
