"""The results in tables."""

from collections.abc import Iterator

from benchmarks.processes import ASSUMED
from robsmooth._support.tables import Table

RATES = ("rate", "reader")


def peers_table(results: dict) -> Table:
    """Return rates, ratios and statistics of all peers, the fastest first."""
    rows = []
    for name, peer in sorted_peers(results):
        off = max(peer["standard_errors_off"].values(), key=abs)
        rows.append(
            (
                name,
                measured_span(peer, "rate", 1e6),
                *(ratio(peer, precision, quartiles=True) for precision in ("single", "mixed")),
                f"{off:+.1f}" + ("" if peer["agrees"] else " DISAGREES"),
                f"{peer['paths']} x {peer['steps'] / 100:g} µs",
            )
        )
    race = results["race"]
    pinned = "one core" if race["pinned"] else "one thread, not kept on one core"
    return Table(
        columns=(
            "implementation",
            "million steps/s",
            "robsmooth, single",
            "robsmooth, mixed",
            "off by, s.e.",
            "a round",
        ),
        rows=rows,
        caption=(
            f"Euler-Maruyama steps of a path a second, on {pinned}, and how many times as fast "
            f"robsmooth is: medians of {race['rounds']} interleaved rounds, with quartiles. Off "
            "by: the worse of both mean squares against robsmooth's with "
            f"{race['reference_paths']} other paths, in standard errors. Those for AVX2 are "
            "compiled for machines without AVX-512, and compared with each other."
        ),
    )


def scale_tables(results: dict) -> Iterator[Table]:
    """Yield how time and memory grow."""
    scales = results["scales"]
    yield Table(
        columns=("threads", "speed-up"),
        rows=[
            (row["threads"], span(row["speed_up"], row["quartiles"])) for row in scales["threads"]
        ],
        caption="Threads, with quartiles.",
    )
    for what in ("runs", "steps"):
        curve = scales[what]
        rows = [
            (size, 1e3 * seconds, 1e6 * seconds / size)
            for size, seconds in zip(curve[what], curve["seconds"], strict=True)
        ]
        yield Table(
            columns=(what, "ms", "µs each"),
            rows=rows,
            caption=f"Time against {what}, all cores: it grows as {what}^{curve['exponent']:.2f}.",
        )
    yield Table(
        columns=("runs", "peak memory, MB"),
        rows=[(row["runs"], row["megabytes"]) for row in scales["memory"]],
        caption="Memory of the whole process, in which the runs go from few to many.",
    )
    yield Table(
        columns=("order", "ns a step", "times order 0"),
        rows=[
            (row["order"], row["nanoseconds"], span(row["relative"], row["quartiles"]))
            for row in scales["orders"]
        ],
        caption="Order of the delay model, one thread: the estimator has one state more.",
    )
    call = scales["first_call"]
    rows = [("import robsmooth", call["import"]), ("first simulation thereafter", call["call"])]
    if "compiling" in call:
        rows.append(("the same where nothing is compiled yet", call["compiling"]))
    if "protocol" in scales:
        rows.append(("50 000 runs of 1 ms, all cores", scales["protocol"]))
    yield Table(columns=("what", "s"), rows=rows, caption="Waiting times.", digits=2)


def any_loop_table(results: dict) -> Table:
    """Return how many steps of any loop are simulated in a second."""
    measured = results["any_loop"]
    rows = [
        (
            name,
            measured_span(row, "rate", 1e6),
            measured_span(row, "ratio"),
            f"{row['off']:+.1f}",
        )
        for name, row in measured["contenders"].items()
    ]
    return Table(
        columns=("rs.simulate by", "million steps/s", "times NumPy", "off by, s.e."),
        rows=rows,
        caption=(
            "The scheme of `rs.simulate` for any loop: steps of a path a second in the paper's "
            "loop, with its classical smoother and copy, and how many times that is what NumPy "
            f"does of the same: medians of {measured['rounds']} interleaved rounds, with "
            "quartiles. Off by: the filtered error against more paths, in standard errors."
        ),
    )


def records_table(results: dict) -> Table:
    """Return how many samples of a record are smoothed in a second."""
    records = results["throughput"]
    rows = [
        (
            name,
            measured_span(row, "rate", 1e6),
            measured_span(row, "ratio"),
            "" if name.startswith("robsmooth") else f"{row['off']:.1e}",
            row["samples"],
        )
        for name, row in records["contenders"].items()
    ]
    return Table(
        columns=("a record by", "million samples/s", "robsmooth", "off by", "samples a round"),
        rows=rows,
        caption=(
            "The discretised smoother of the example, three states: samples a second on one core, "
            "and how many times as fast robsmooth is without gaps and copies: medians of "
            f"{records['rounds']} interleaved rounds, with quartiles. Off by: the largest "
            "difference to robsmooth's estimates, of the largest estimate."
        ),
    )


def files_table(results: dict) -> Table:
    """Return how many rows a second are smoothed from file to file."""
    measured = results["from_files"]
    rows = []
    for name, row in measured["paths"].items():
        rates = [measured_span(row, of, 1e6) for of in RATES]
        rows.append((name, *rates, measured_span(row, "share")))
    return Table(
        columns=("from file to file", "million rows/s", "its reader alone", "share"),
        rows=rows,
        caption=(
            f"`smooth_record` on {measured['rows']:,} rows of one measurement, on one core, beside "
            "what reads the file and does nothing with it (PyArrow, NumPy for NPY): medians of "
            f"{measured['rounds']} interleaved rounds, with quartiles."
        ),
    )


def latency_tables(results: dict) -> Iterator[Table]:
    """Yield how long one sample takes, from Python and in C."""
    rows = []
    for name, row in results["latency"]["contenders"].items():
        times = [f"{each:.3g}" for each in row["nanoseconds"]]
        times += [""] * (3 - len(times))
        rows.append((name, *times, measured_span(row, "ratio")))
    yield Table(
        columns=("a sample by", "ns: median", "99%", "99.9%", "times as fast"),
        rows=rows,
        caption=(
            "The same smoother, a sample at a time, on one core: the time of a call from Python, "
            "or of one of many in a loop of C. Times as fast as the first row: medians of "
            f"{results['latency']['rounds']} interleaved rounds, with quartiles."
        ),
    )


def guarantees_table(results: dict) -> Table:
    """Return what designs certify, and how long the minimax one takes."""
    rows = [
        (row["plant"], row["classical"], row["tuned"], row["minimax"], 1e3 * row["seconds"])
        for row in results["guarantees"]
    ]
    return Table(
        columns=("system", "classical", "tuned", "minimax", "ms"),
        rows=rows,
        caption=(
            "Certified mean square errors against the delay model's output, of the classical "
            "smoother, the same tuned for it, and the minimax smoother, and the median time of "
            "the latter's design."
        ),
    )


def kalman_tables(results: dict) -> Iterator[Table]:
    """Yield how many samples exact smoothers take in a second, at a fixed lag and in all."""
    for uses, rows in results["kalman"]["uses"].items():
        yield Table(
            columns=(f"a record {uses}, by", "thousand samples/s", "robsmooth", "off by"),
            rows=[
                (
                    name,
                    measured_span(row, "rate", 1e3),
                    measured_span(row, "ratio"),
                    off_by(row) if not name.startswith("robsmooth") else "",
                )
                for name, row in rows.items()
            ],
            caption=(
                "The example with its exact delay of 31 samples, from a stationary start, on one "
                "core, and how many times as fast robsmooth is: medians of "
                f"{results['kalman']['rounds']} interleaved rounds, with quartiles. A delay line "
                "keeps 31 former outputs in the state. Off by: the largest difference to "
                "robsmooth's estimates, of the largest estimate."
            ),
        )


def riccati_table(results: dict) -> Table:
    """Return how long a filter's design takes, at some numbers of states."""
    rows = [
        (
            row["states"],
            row["name"],
            1e3 * row["seconds"],
            measured_span(row, "ratio"),
            "" if row["name"].startswith("robsmooth") else f"{row['off']:.1e}",
        )
        for row in results["riccati"]["rows"]
    ]
    return Table(
        columns=("states", "a Kalman-Bucy filter by", "ms", "robsmooth", "off by"),
        rows=rows,
        caption=(
            "A design from a system, on one core, and how many times as fast robsmooth "
            "is, which also checks the system and certifies its solution. Off by: the largest "
            "difference of the gains, of the largest."
        ),
        digits=3,
    )


def growth_table(results: dict) -> Table:
    """Return the fitted exponents, and why they are so."""
    rows = [
        (
            row["name"],
            row["against"],
            ", ".join(f"{size:,}" for size in row["sizes"]),
            ", ".join(f"{1e3 * seconds:.3g}" for seconds in row["seconds"]),
            span(row["exponent"], row["quartiles"]),
            row["reason"],
        )
        for row in results["growth"]["curves"]
    ]
    return Table(
        columns=("time of", "against", "sizes", "ms", "exponent", "because of"),
        rows=rows,
        caption=(
            "How time grows, on one core: exponents that fit the largest three sizes, medians over "
            "the rounds, with quartiles."
        ),
    )


def aims_table(results: dict) -> Table:
    """Return what users wait for beside what is aimed at."""
    rows = [
        (
            row["name"],
            amount(row, "measured"),
            amount(row, "aim"),
            "yes" if row["measured"] <= row["aim"] else "no",
        )
        for row in results["targets"]
    ]
    return Table(
        columns=("after a first call", "here", "aim", "met"),
        rows=rows,
        caption=(
            "What is waited for, on this machine: medians. All but the minimax smoother and the "
            "sweep of many states are of the paper's example."
        ),
    )


def summary_table(results: dict) -> Table:
    """Return every peer of every work, with how many times as fast robsmooth is."""
    rows = []
    for name, peer in sorted_peers(results):
        for precision in ("single", "mixed"):
            if not name.startswith("robsmooth"):
                off = f"{max(peer['standard_errors_off'].values(), key=abs):+.1f} s.e."
                cells = name, ratio(peer, precision, quartiles=True), off
                rows.append((f"path-steps, {precision}", *cells))
    works = {"samples, delay model": results["throughput"]["contenders"]}
    works |= {f"samples, {uses}": found for uses, found in results["kalman"]["uses"].items()}
    for work, contenders in works.items():
        for name, row in contenders.items():
            if not name.startswith("robsmooth"):
                cells = name, measured_span(row, "ratio"), off_by(row)
                rows.append((work, *cells))
    for row in results["riccati"]["rows"]:
        if not row["name"].startswith("robsmooth"):
            cells = row["name"], measured_span(row, "ratio"), f"{row['off']:.1e}"
            rows.append((f"a filter of {row['states']} states", *cells))
    return Table(
        columns=("work", "peer", "robsmooth is times as fast", "off by"),
        rows=rows,
        caption=(
            "Every peer, on one core: medians of interleaved rounds, with quartiles. Off by: the "
            "difference to robsmooth's result, in standard errors where it is random, and else of "
            "the largest number of the result."
        ),
    )


def cost_tables(results: dict) -> Iterator[Table]:
    """Yield what was measured up to two cores, and what that makes of large simulations."""
    measured, cost = results["processes"], results["processes"]["cost"]
    rates, speed_up, worth = measured["rates"], measured["speed_up"], measured["worth"]
    ways = {"one thread": "one", "one thread, single precision": "single"}
    ways |= {"two threads": "threads", "two processes of a Dask cluster": "processes"}
    yield Table(
        columns=("path-steps by", "million/s", "times one thread"),
        rows=[
            (name, rates[key] / 1e6, span(speed_up[key][0], speed_up[key][1:]))
            for name, key in ways.items()
        ],
        caption=(
            f"Measured here: {measured['path_steps']:.2g} path-steps of the paper's protocol, "
            f"interleaved. A cluster starts, imports and answers first in {measured['start']:.0f} s"
            f"; a call costs its client {1e3 * measured['call']:.1f} ms; a worker takes "
            f"{measured['megabytes']:.0f} MB. The default answer knows the smoothed error to "
            f"{worth['relative']:.1e} of it from {worth['path_steps']:.1e} path-steps; the paper's "
            f"protocol needs {worth['literal']:.0e} for as much."
        ),
    )
    yield Table(
        columns=("path-steps", "core-hours", "on 100 cores", "on 1000 cores"),
        rows=[
            (
                f"{row['path_steps']:.0e}",
                f"{row['core_seconds'] / 3600:.2g}",
                *(duration(row["core_seconds"] / cores) for cores in (100, 1000)),
            )
            for row in cost["rows"]
        ],
        caption=(
            "Computed, not measured, from the first table's one thread and the share of a core "
            f"that each of two processes has, {cost['share']:.2f}. Assumed: "
            f"{'; '.join(ASSUMED)}. A call then lasts at most {duration(cost['call'])}, so that "
            f"one client feeds {cost['fed']:.0f} cores at most; the start comes on top."
        ),
    )


def since_table(results: dict) -> Table:
    """Return every ratio beside that of the last run."""
    rows = [
        (row["name"], span(row["before"]), span(row["now"]), "WORSE" if row["worse"] else "")
        for row in results["since"]["rows"]
    ]
    return Table(
        columns=("ratio, the higher the better", "before", "now", ""),
        rows=rows,
        caption=(
            f"Beside the run of {results['since']['written']} on a machine of this kind. Worse is "
            "what has fallen by a tenth, and below where the quartiles of both overlap."
        ),
    )


# --- helpers -------------------------------------------------------------------------------------


def sorted_peers(results: dict) -> list[tuple[str, dict]]:
    """Return names and results of the peers of the simulation, the fastest first."""
    return sorted(results["race"]["peers"].items(), key=lambda item: -item[1]["rate"])


def ratio(peer: dict, precision: str, quartiles: bool = False) -> str:
    """Return how many times as fast robsmooth is, with quartiles where asked."""
    value = peer[f"ratio_{precision}"]
    return span(value, peer[f"ratio_{precision}_quartiles"] if quartiles else None)


def span(value: float, quartiles: list[float] | None = None) -> str:
    """Return a number with its quartiles, to what digits are worth."""

    def text(number: float) -> str:
        return (
            f"{number:.2f}"
            if number < 9.995
            else f"{number:.1f}"
            if number < 99.95
            else f"{number:.0f}"
        )

    return text(value) + (f" ({text(quartiles[0])} to {text(quartiles[1])})" if quartiles else "")


def measured_span(row: dict, key: str, unit: float = 1.0) -> str:
    """Return what was measured, in a unit, with its quartiles."""
    return span(row[key] / unit, [each / unit for each in row[f"{key}_quartiles"]])


def off_by(row: dict) -> str:
    """Return how far estimates are off; after its start for a peer that computes something else."""
    return f"{row['off_late']:.0e}, see above" if row.get("differs") else f"{row['off']:.1e}"


def amount(row: dict, key: str) -> str:
    """Return a measured value or an aim with its unit."""
    return f"{1e3 * row[key]:.3g} ms" if row["unit"] == "s" else f"{row[key]:.3g}"


def duration(seconds: float) -> str:
    """Return a time in a unit that suits it."""
    for unit, length in (("d", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.3g} {unit}"
    return f"{seconds:.2g} s"
