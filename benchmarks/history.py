"""Former results of a machine, which new ones are judged by.

`benchmarks/history/` has a file for each kind of machine, with its last runs. Only ratios are kept,
each to something that was timed in the same rounds: a machine that is slower today changes them
little. Of all, the higher is the better.
"""

import json
from collections.abc import Iterator
from pathlib import Path

from benchmarks.machine import slug
from robsmooth._support import files

FOLDER = Path(__file__).parent / "history"
LEAST = 0.10  # by which a ratio must be worse to be called so
KEPT = 20  # runs


def figures(results: dict) -> dict[str, list[float]]:
    """Return median and quartiles of every ratio."""
    return {name: [ratio, *quartiles] for name, ratio, quartiles in _ratios(results)}


def _ratios(results: dict) -> Iterator[tuple[str, float, list[float]]]:
    for name, peer in results["race"]["peers"].items():
        for precision in ("single", "mixed"):
            if not name.startswith("robsmooth"):
                ratio, quartiles = (peer[f"ratio_{precision}{end}"] for end in ("", "_quartiles"))
                yield f"{precision}, times {name}", ratio, quartiles
    for name, row in results["throughput"]["contenders"].items():
        if not name.startswith("robsmooth"):
            yield f"a record, times {name}", row["ratio"], row["ratio_quartiles"]
        elif name != "robsmooth":
            yield _inverted(f"a record by {name}, times that without", row)
    for rows in results["kalman"]["uses"].values():
        for name, row in rows.items():
            if not name.startswith("robsmooth"):
                yield f"a record, times {name}", row["ratio"], row["ratio_quartiles"]
    for name, row in results["from_files"]["paths"].items():
        yield f"{name}, share of its reader", row["share"], row["share_quartiles"]
    by_hand = results["latency"]["contenders"]["NumPy, matrix times vector"]
    yield "a step, times NumPy", 1 / by_hand["ratio"], _inverse(by_hand["ratio_quartiles"])
    for row in results["riccati"]["rows"]:
        if row["ratio"] != 1.0:
            name = f"a design of {row['states']} states, times {row['name']}"
            yield name, row["ratio"], row["ratio_quartiles"]
    for name, row in results["any_loop"]["contenders"].items():
        if name.startswith("robsmooth"):
            yield f"any loop: {name}, times NumPy", row["ratio"], row["ratio_quartiles"]
    for row in results["targets"]:
        if "ratio" in row:
            yield _inverted(f"{row['name']}, in yardsticks", row)
    for row in results["scales"]["threads"][1:]:
        yield f"{row['threads']} threads, times one", row["speed_up"], row["quartiles"]


def _inverted(name: str, row: dict) -> tuple[str, float, list[float]]:
    return name, 1 / row["ratio"], _inverse(row["ratio_quartiles"])


def _inverse(quartiles: list[float]) -> list[float]:
    return [1 / value for value in reversed(quartiles)]


def former(machine: dict, folder: Path | None = None) -> list[dict]:
    """Return the runs of this kind of machine, the oldest first."""
    path = (folder or FOLDER) / f"{slug(machine)}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []


def compared(now: dict[str, list[float]], runs: list[dict]) -> dict:
    """Return every ratio beside that of the last run; say which are worse.

    A ratio is worse where it is lower by a tenth, and by more than its quartiles and the former
    ones overlap.
    """
    if not runs:
        return {"written": None, "commit": None, "rows": []}
    last = runs[-1]
    rows = []
    for name, (ratio, _, high) in now.items():
        if name in last["figures"]:
            before, before_low, _ = last["figures"][name]
            worse = ratio < (1 - LEAST) * before and high < before_low
            rows.append({"name": name, "before": before, "now": ratio, "worse": worse})
    return {"written": last["written"], "commit": last["commit"], "rows": rows}


def keep(about: dict, now: dict[str, list[float]], folder: Path | None = None) -> Path:
    """Append a run to those of its machine; return the file."""
    folder = folder or FOLDER
    folder.mkdir(exist_ok=True)
    path = folder / f"{slug(about['machine'])}.json"
    rounded = {name: [float(f"{value:.4g}") for value in values] for name, values in now.items()}
    revision = about["revision"] or {"commit": None}
    run = {"written": about["written"], "commit": revision["commit"], "figures": rounded}
    files.write_json(path, [*former(about["machine"], folder), run][-KEPT:])
    return path
