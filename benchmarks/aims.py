"""What is aimed at, and what of it the results miss, disturb or contradict."""

from collections.abc import Iterator

from benchmarks.guarantees import LONGEST
from benchmarks.machine import FOR_AVX2
from benchmarks.tables import amount, span

BUSY = 0.3  # of the cores
# How many times as fast as a peer robsmooth is at least, in which precision.
RACE = {
    ("C++, single", "single"): 0.95,
    ("C++, mixed", "mixed"): 0.95,
    ("NumPy, float32", "single"): 10.0,
    ("NumPy, float64", "mixed"): 10.0,
    ("JAX, float32", "single"): 8.0,
}


ANY_LOOP = 20.0  # times NumPy, on all threads


def is_complete(results: dict) -> bool:
    """Tell whether everybody with an aim was measured, and all peers agree."""
    peers = results["race"]["peers"]
    return all(name in peers for name, _ in RACE) and not disagreeing(results)


def disagreeing(results: dict) -> list[str]:
    """Return the peers whose results are not robsmooth's."""
    parts = "throughput", "latency", "any_loop"
    contenders = [results[part]["contenders"] for part in parts]
    measured = [results["race"]["peers"], *contenders, *results["kalman"]["uses"].values()]
    named = [(name, row) for rows in measured for name, row in rows.items()]
    named += [(row["name"], row) for row in results["riccati"]["rows"]]
    wrong = [name for name, row in named if not row["agrees"]]
    return wrong if results["processes"]["same_bits"] else [*wrong, "a cluster of processes"]


def remarks(results: dict) -> list[str]:
    """Say what was skipped and why, what disturbed, what is missed, and what has become worse."""
    misses = [*shortfalls(results), *regressions(results)]
    return [*skipped(results), *differing(results), *disturbances(results), *misses]


def skipped(results: dict) -> list[str]:
    """Say which peers were left out, and why."""
    parts = [results[part]["skipped"] for part in ("race", "kalman", "riccati")]
    return [f"skipped: {name}: {reason}" for part in parts for name, reason in part.items()]


def differing(results: dict) -> list[str]:
    """Say which peers compute something else, and what."""
    rows = [item for uses in results["kalman"]["uses"].values() for item in uses.items()]
    return [
        f"{name} computes something else, off by {row['off_late']:.1g} after its start: "
        f"{row['differs']}"
        for name, row in rows
        if row["differs"]
    ]


def disturbances(results: dict) -> list[str]:
    """Say whether the machine had other things to do."""
    load, cores = results["about"]["load_before"], results["about"]["machine"]["cores"]
    if load < BUSY * cores:
        return []
    return [
        f"the machine was busy (load {load:.1f}): ratios to peers stand; times, and the ratios of "
        "threads and processes, may not"
    ]


def is_overloaded(about: dict) -> bool:
    """Tell whether others had as much to do as the whole machine can: then times mean nothing."""
    return about["load_before"] > about["machine"]["cores"]


def shortfalls(results: dict) -> list[str]:
    """Say which aims are not met."""
    found = _slow_waits, _slow_designs, _slow_races, _slow_loop
    return [text for each in found for text in each(results)]


def _slow_waits(results: dict) -> Iterator[str]:
    for row in results["targets"]:
        if row["measured"] > row["aim"]:
            yield f"{row['name']}: {amount(row, 'measured')}; the aim is {amount(row, 'aim')}"


def _slow_designs(results: dict) -> Iterator[str]:
    for row in results["guarantees"]:
        if row["seconds"] > LONGEST:
            yield (
                f"the minimax smoother of {row['plant']} takes {row['seconds']:.1f} s; the aim is "
                f"{LONGEST:g} s"
            )


def _slow_races(results: dict) -> Iterator[str]:
    peers = results["race"]["peers"]
    for (name, precision), aim in RACE.items():
        for each in sorted(peers.keys() & {name, name + FOR_AVX2}):
            ratio = peers[each][f"ratio_{precision}"]
            if ratio < aim:
                ours = f"robsmooth, {precision}"
                yield f"{ours}, is {span(ratio)} times as fast as {each}; the aim is {aim:g}"


def _slow_loop(results: dict) -> Iterator[str]:
    *_, (name, row) = results["any_loop"]["contenders"].items()
    if row["ratio"] < ANY_LOOP:
        yield f"simulate: {name}, {span(row['ratio'])} times NumPy; the aim is {ANY_LOOP:g}"


def regressions(results: dict) -> list[str]:
    """Say which ratios are worse than those of the last run on a machine of this kind."""
    return [
        f"WORSE than on {results['since']['written'][:10]}: {row['name']}: "
        f"{span(row['now'])}, before {span(row['before'])}"
        for row in results["since"]["rows"]
        if row["worse"]
    ]
