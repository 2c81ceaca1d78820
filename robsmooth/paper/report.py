"""The report of the reproduction: every printed number with its verdict, and the scorecard."""

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from robsmooth._support import files
from robsmooth._support.tables import Table
from robsmooth.paper import verdicts as paper_verdicts
from robsmooth.paper.verdicts import NOT_REPRODUCED, OUTCOMES, WITH_FLIPPED_SIGN, Verdict, table
from robsmooth.workbench import provenance

_BEGIN, _END = "<!-- scorecard: written by make figures -->", "<!-- end of scorecard -->"


def write(figures: Path, data: Path) -> list[Verdict]:
    """Write the report on the results in `data` to `figures` if it changed; return its verdicts."""
    started = time.perf_counter()
    verdicts = paper_verdicts.verdicts(data)
    report, spreadsheet = figures / "reproduction.md", figures / "reproduction.csv"
    texts = {report: markdown(verdicts), spreadsheet: table(verdicts).csv()}
    if not all(path.is_file() and path.read_bytes() == texts[path].encode() for path in texts):
        for path, text in texts.items():
            files.write_text(path, text)
        provenance.write(report, started=started)
    return verdicts


def write_scorecard(readme: Path, verdicts: Iterable[Verdict]) -> None:
    """Put the counts of the scorecard between its marks in the README."""
    before, begin, rest = readme.read_text(encoding="utf-8").partition(_BEGIN)
    _, end, after = rest.partition(_END)
    if not (begin and end):
        raise ValueError(f"{readme.name} must have the marks {_BEGIN!r} and {_END!r}")
    *rows, total = scorecard(verdicts).rows
    for column, kind in enumerate(("printed numbers", "statements"), start=1):
        counts = ", ".join(f"{row[column]} {row[0]}" for row in rows if row[column])
        begin += f"\nOf {total[column]} {kind}: {counts}."
    files.write_text(readme, f"{before}{begin}\n{end}{after}")


def scorecard(verdicts: Iterable[Verdict]) -> Table:
    """Return how many printed numbers and statements have each verdict."""
    counts = Counter((each.verdict, isinstance(each.value, str)) for each in verdicts)
    rows = [(outcome, counts[outcome, False], counts[outcome, True]) for outcome in OUTCOMES]
    total = ("all", sum(row[1] for row in rows), sum(row[2] for row in rows))
    columns = ("verdict", "printed numbers", "statements")
    caption = "What of the paper reproduces. Each entry of a printed matrix counts as a number."
    return Table(columns, [*rows, total], caption)


def markdown(verdicts: Sequence[Verdict]) -> str:
    """Return the report: the scorecard, what needs a reason, then everything."""
    parts = [
        "# What of the paper reproduces",
        "Written by `make figures`; the same as a table is in `reproduction.csv`. A number counts "
        "as reproduced when rounding ours, or cutting it off, at the printed digits gives what is "
        "printed. What follows from the printed tau and lambda counts when it does so for some "
        "values that round to the printed ones. Matrix entries are counted from zero.",
        scorecard(verdicts).markdown(),
    ]
    for outcome in (NOT_REPRODUCED, WITH_FLIPPED_SIGN):
        chosen = [verdict for verdict in verdicts if verdict.verdict == outcome]
        title = outcome.capitalize()
        parts += [f"## {title}", table(chosen, f"{title}.").markdown()]
    everything = table(verdicts, "All verdicts. The zeros of a matrix share a row.", True)
    parts += ["## Everything, in the paper's order", everything.markdown()]
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def about() -> Table:
    """Return a table of the versions, revision, lock and machine that a notebook runs with."""
    facts = provenance.collect()
    revision, machine = facts["revision"], facts["machine"]
    rows = [*facts["versions"].items()]
    if revision:
        changed = ", with changes" if revision["dirty"] else ""
        rows.append(("git revision", revision["commit"][:12] + changed))
    rows.append(("lock (SHA-256)", (facts["lock_sha256"] or "none")[:12]))
    rows.append(("processor", f"{machine['processor']}, {machine['cores']} cores"))
    rows += [("platform", machine["platform"]), ("run at", facts["written"])]
    return Table(("what", "version"), rows, "Run with.")
