"""Damaged files of every kind that is read: ``python -m tests.attacks.mutate_files --kind K``.

A file that the package reads, of a design, a record or a notebook's parameters, has some of its
bytes, words, numbers or nested values changed. It may be read, or be refused by an error that the
package words itself, in one sentence; within 2 s of computing and 1 GB.
"""

import argparse
import json
import os
import random
import re
import shutil
import sys
import tempfile
import time
import tomllib
import warnings
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from pyarrow import parquet

import robsmooth as rs
from robsmooth.io.designs import _toml
from robsmooth.workbench import parameters, runner
from tests.helpers import trials

TRIES = 20_000
SECONDS = float(os.environ.get("ATTACK_SECONDS", "2"))  # of computing
NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
FOLDER = Path(tempfile.mkdtemp(prefix="mutate-"))
PAPER = rs.homodyne.PAPER


@cache
def smoother() -> Any:
    return rs.baselines.kalman_bucy(PAPER.uncertain_system()).discretize(1e-6)


@cache
def designs(suffix: str) -> list[bytes]:
    """Return files of designs of all kinds."""
    system = PAPER.uncertain_system()
    plant = rs.augment(system, 3.1e-6, 2)
    robust = rs.design_smoother(plant, 1.0987e-6, [1.0, 0.4999, 1e-6, 1e-6])
    classical = rs.baselines.fixed_lag_smoother(system, 3.1e-6, 2)
    minimax = rs.minimax_smoother(plant)
    found = []
    for value in (system, plant, robust, classical, minimax, classical.discretize(1e-6)):
        rs.save(value, FOLDER / f"saved.{suffix}")
        found.append((FOLDER / f"saved.{suffix}").read_bytes())
    return found


def samples() -> np.ndarray:
    noise = np.random.default_rng(0).standard_normal(40)
    return np.column_stack([1e-6 * np.arange(40.0), noise])


@cache
def records(suffix: str) -> list[bytes]:
    """Return files of records."""
    path, found = FOLDER / f"given.{suffix}", []
    if suffix == "npy":
        for array in (samples(), samples().astype("f4"), np.asfortranarray(samples())):
            np.save(path, array)
            found.append(path.read_bytes())
    elif suffix == "parquet":
        for times in (samples()[:, 0], np.arange(40).astype("datetime64[us]")):
            table = pyarrow.table([times, samples()[:, 1]], names=["time", "y"])
            parquet.write_table(table, path)
            found.append(path.read_bytes())
    else:
        for header in ("", "time,y"):
            np.savetxt(path, samples(), "%.17g", ",", header=header, comments="")
            found.append(path.read_bytes())
        dates = np.datetime_as_string(np.arange(40).astype("datetime64[us]"))
        rows = zip(dates, samples()[:, 1], strict=True)
        found.append("".join(f"{date},{value:.17g}\n" for date, value in rows).encode())
    return found


@cache
def cells() -> list[bytes]:
    return [path.read_bytes() for path in sorted(NOTEBOOKS.glob("0*.ipynb"))]


def read_design(path: Path) -> None:
    rs.load(path)


def read_record(path: Path) -> None:
    smoother().reset()
    rs.smooth_record(smoother(), path, FOLDER / "target.npy", columns=1, time=0)


def read_cell(path: Path) -> None:
    parameters.read(path)


def read_profiles(path: Path) -> None:
    folder = FOLDER / "notebooks"
    if not folder.is_dir():
        shutil.copytree(NOTEBOOKS, folder, ignore=shutil.ignore_patterns("profiles.toml"))
    path.replace(folder / "profiles.toml")
    profiles = runner._profiles(folder)
    for name in runner.select(profiles["notebooks"], ()):
        for profile in runner.PROFILES:
            there = known().get(name) or parameters.read(folder / f"{name}.ipynb")
            parameters.check(there, profiles.get(profile, {}).get(name, {}), "profiles.toml")


@cache
def known() -> dict[str, Any]:
    return {path.stem: parameters.read(path) for path in NOTEBOOKS.glob("*.ipynb")}


KINDS: dict[str, tuple[Callable[[], list[bytes]], Callable[[Path], None], str]] = {
    "toml": (partial(designs, "toml"), read_design, "toml"),
    "json": (partial(designs, "json"), read_design, "json"),
    "csv": (partial(records, "csv"), read_record, "csv"),
    "npy": (partial(records, "npy"), read_record, "npy"),
    "parquet": (partial(records, "parquet"), read_record, "parquet"),
    "cells": (cells, read_cell, "ipynb"),
    "profiles": (lambda: [(NOTEBOOKS / "profiles.toml").read_bytes()], read_profiles, "toml"),
}
ODD = [
    *(b"", b"0", b"-1", b"1e999", b"-1e999", b"nan", b"inf", b"-inf", b"1e308", b"5e-324", b"null"),
    *(
        b"true",
        b"9" * 400,
        b"9" * 5000,
        b"1" + b"0" * 18,
        b"0x10",
        b"1_0",
        b'"x"',
        b"'",
        b'"',
        b",",
    ),
    *(
        b"[]",
        b"{}",
        b"[[]]",
        b"[",
        b"]",
        b"{",
        b"}",
        b"\0",
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        b"\r",
        b"\n",
    ),
    *(b"\xc3\xa9", b"\xed\xa0\x80", b"\\ud800", b"=", b"#", b"2020-01-01", b"1979-05-27T07:32:00Z"),
    *(b"[" * 3000, b"[" * 100_000, b"{" * 2000, b'{"a":' * 50_000, b"a" * 300_000, b"1," * 200_000),
    *(b"\n" * 5000, b"(" * 3000, b"-" * 3000, b"~" * 3000, b"a." * 20_000, b"1000000", b"10**400"),
    *(b"<U8", b"|O", b"<c16", b"|b1", b"<m8[s]", b"|V16", b"True", b"(1000000000000,)", b"(-1, 2)"),
    *(
        b"__import__('os')",
        b"1e400000000",
        b"\x1f\x8b",
        b"PAR1",
        b"lambda: 0",
        b"9" * 100 + b"e-90",
    ),
]
VALUES: list[Any] = [
    *(None, True, False, 0, -1, 1, 2.5, 1e308, -1e308, 5e-324, 10**400, 10**15, 10**6, 300, ""),
    *([], [[]], [[[]]], {}, {"x": 1}, [1.0], [[1.0]], [[1.0, 2.0]], [None], ["x"], [[1.0], [2, 3]]),
    *("system", "sin", "smoothed", "SI", [{}], float("nan"), float("inf"), [True], [10**400], "x"),
]


def places(value: Any, at: tuple = ()) -> list[tuple]:
    """Return where the values nested in one are."""
    found = [at]
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, part in items:
            found += places(part, (*at, key))
    return found


def nested(rng: random.Random, content: Any) -> Any:
    """Change a value nested in a file's content."""
    content = json.loads(json.dumps(content))
    *way, last = rng.choice([at for at in places(content) if at])
    holder = content
    for key in way:
        holder = holder[key]
    what = rng.randrange(4)
    if what == 0:
        del holder[last]
    elif what == 1 and isinstance(holder, list):
        holder.append(holder[last])
    elif what == 2 and isinstance(holder[last], int | float) and abs(holder[last]) < 1e300:
        holder[last] *= rng.choice([0, -1, 1e-9, 1e9, 2, 0.5, 1e300])
    else:
        holder[last] = rng.choice(VALUES)
    return content


def mutated(rng: random.Random, kind: str, text: bytes) -> bytes:
    """Return a file's bytes with some changes."""
    with_values = {"json": json.loads, "toml": tomllib.loads, "cells": json.loads}
    if kind in with_values and rng.random() < 0.4:
        content = with_values[kind](text.decode())
        for _ in range(rng.choice([1, 1, 2, 4])):
            content = nested(rng, content) if content else content
        try:
            text = (
                "\n".join(_toml(content, "")) if kind == "toml" else json.dumps(content)
            ).encode()
        except Exception:  # it is no table
            text = json.dumps(content).encode()
        return text
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        text = once(rng, text, 128 if kind == "npy" and rng.random() < 0.8 else len(text))
    return text


def once(rng: random.Random, text: bytes, end: int) -> bytes:
    """Return bytes with a change before an end."""
    end = max(min(end, len(text)), 1)
    i, j = sorted(rng.randrange(end) for _ in range(2))
    j = min(j, i + rng.choice([1, 4, 30, 1000]))
    what = rng.randrange(8)
    if what == 0:
        return text[:i] + bytes([rng.randrange(256)]) + text[i + 1 :]
    if what == 1:
        return text[:i] + text[j:]
    if what == 2:
        return text[:i] + rng.choice(ODD) + text[i:]
    if what == 3:
        return text[:j] + text[i:j] * rng.choice([1, 2, 50]) + text[j:]
    if what == 4:
        return text[:i]
    words = list(re.finditer(rb"[\w.+-]+|\S", text[:end]))
    if not words:
        return rng.choice(ODD)
    one, other = rng.choice(words), rng.choice(words)
    by = rng.choice(ODD) if what < 7 else other[0]
    return text[: one.start()] + by + text[one.end() :]


def trial(kind: str, seed: int, number: int) -> tuple[str, str | None]:
    """Read a damaged file; return the outcome, and the failure if there is one."""
    make, read, suffix = KINDS[kind]
    texts, path = make(), FOLDER / f"damaged.{suffix}"
    if number < 0:
        for text in texts:
            path.write_bytes(text)
            read(path)
        return "ready", None
    rng = random.Random(f"{kind}, {seed}, {number}")
    path.write_bytes(mutated(rng, kind, rng.choice(texts)))
    outcome, failure, started = "read", None, time.process_time()
    try:
        with warnings.catch_warnings(action="ignore"):
            read(path)
    except Exception as error:
        outcome, failure = "refused", trials.fault_of(error)
    took = time.process_time() - started
    if failure is None and took > SECONDS:
        failure = f"{took:.1f} s"
    return outcome, None if failure is None else f"{kind}: {failure}"


def main() -> None:
    """Attack from the command line; exit with 1 where anything has failed."""
    parser = argparse.ArgumentParser(description="damaged files")
    parser.add_argument("--tries", type=int, default=TRIES, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=list(KINDS), action="append")
    given, failed = parser.parse_args(), False
    for kind in given.kind or KINDS:
        failed |= trials.report(f"damaged {kind}", partial(trial, kind), given.tries, given.seed)
    sys.exit(failed)


if __name__ == "__main__":
    main()
