"""Make every attack of this folder: ``python -m tests.attacks --tries N --only NAME``.

A script prints what it tried in lines such as ``kill a worker: 20 tries, 0 failures``, and its exit
code is 1 after a failure.
"""

import argparse
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
COUNTS = re.compile(r"(\S.*?): (\d+) tries, (\d+) failures")
Row = tuple[str, str, str, str]  # attack, tries, failures, seconds


def make(script: Path, arguments: Sequence[str]) -> tuple[list[Row], bool]:
    """Run a script and show what it prints; return a row for each attack, and whether all held."""
    started, rows = time.perf_counter(), []
    command = [sys.executable, "-m", f"tests.attacks.{script.stem}", *arguments]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "errors": "replace"}
    with subprocess.Popen(command, cwd=FOLDER.parents[1], text=True, **options) as process:
        for line in process.stdout:
            print(line, end="", flush=True)
            if found := COUNTS.match(line):
                seconds = time.perf_counter() - started
                rows.append((f"{script.stem}: {found[1]}", found[2], found[3], f"{seconds:.0f}"))
                started = time.perf_counter()
    if process.returncode or not rows:  # it failed, or told of no try
        seconds = f"{time.perf_counter() - started:.0f}"
        rows.append((script.stem, "", f"exit code {process.returncode}", seconds))
    return rows, process.returncode == 0 and all(row[2] == "0" for row in rows)


def table(rows: Sequence[Row]) -> str:
    """Return the rows below the names of their columns."""
    rows = [("attack", "tries", "failures", "seconds"), *rows]
    width = max(len(row[0]) for row in rows)
    return "\n".join(
        f"{name:<{width}}  {tries:>7}  {failures:>12}  {seconds:>7}"
        for name, tries, failures, seconds in rows
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the attacks that are asked for; return 1 where any has failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.attacks", description=__doc__)
    parser.add_argument("--tries", type=int, help="of each attack (default: the script's own)")
    parser.add_argument("--only", default="", help="a part of the names of the scripts to run")
    given, rows, held = parser.parse_args(arguments), [], True
    scripts = [path for path in sorted(FOLDER.glob("[!_]*.py")) if given.only in path.stem]
    if not scripts:
        parser.error(f"--only: no script of {FOLDER.name}/ has {given.only!r} in its name")
    for script in scripts:
        print(f"--- {script.stem}", flush=True)
        found, good = make(script, [] if given.tries is None else [f"--tries={given.tries}"])
        rows, held = [*rows, *found], held and good
    print(f"\n{table(rows)}")
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
