"""The results in words, tables and a figure, and in the README."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks.design import AIM as DESIGN_AIM
from benchmarks.guarantees import LONGEST
from robsmooth._support import files
from robsmooth._support.tables import Table
from robsmooth.paper import figures

FOLDER = Path(__file__).parent
RATES = ("rate", "reader")
BUSY = 0.3  # of the cores
BEGIN, END = "<!-- bench: written by make bench -->", "<!-- end of bench -->"
# What we want: how many times as fast as a peer robsmooth is at least, in which precision.
AIMS = {
    ("C++, single", "single"): 0.80,
    ("C++, mixed", "mixed"): 0.80,
    ("NumPy, float32", "single"): 10.0,
    ("NumPy, float64", "mixed"): 10.0,
    ("JAX, float32", "single"): 8.0,
}


def is_complete(results: dict) -> bool:
    """Tell whether everybody with an aim was measured, and all peers agree."""
    peers = results["race"]["peers"]
    return all(name in peers for name, _ in AIMS) and not disagreeing(results)


def disagreeing(results: dict) -> list[str]:
    """Return the peers whose results are not robsmooth's."""
    latency = results.get("latency", {}).get("contenders", {})
    measured = {**results["race"]["peers"], **results["records"]["contenders"], **latency}
    return [name for name, peer in measured.items() if not peer["agrees"]]


def remarks(results: dict) -> list[str]:
    """Say what was skipped and why, what disturbed, and which aims are not met."""
    return [*skipped(results), *disturbances(results), *shortfalls(results)]


def skipped(results: dict) -> list[str]:
    """Say which peers were left out, and why."""
    return [f"skipped: {name}: {reason}" for name, reason in results["race"]["skipped"].items()]


def disturbances(results: dict) -> list[str]:
    """Say whether the machine had other things to do."""
    load, cores = results["about"]["load_before"], results["about"]["machine"]["cores"]
    if load < BUSY * cores:
        return []
    return [f"the machine was busy (load {load:.1f}): ratios to peers stand, the threads' may not"]


def shortfalls(results: dict) -> list[str]:
    """Say which aims are not met."""
    peers, both = results["race"]["peers"], results["design"]["both"]
    late = [] if both <= DESIGN_AIM else [_late(both)]
    late += [
        f"the minimax smoother of {row['plant']} takes {row['seconds']:.1f} s; the aim is "
        f"{LONGEST:g} s"
        for row in results["guarantees"]
        if row["seconds"] > LONGEST
    ]
    return late + [
        f"robsmooth, {precision}, is {_ratio(peers[name], precision)} times as fast as {name}; "
        f"the aim is {aim:g}"
        for (name, precision), aim in AIMS.items()
        if name in peers and peers[name][f"ratio_{precision}"] < aim
    ]


# --- tables --------------------------------------------------------------------------------------


def peers_table(results: dict) -> Table:
    """Return rates, ratios and statistics of all peers, the fastest first."""
    rows = []
    for name, peer in _sorted_peers(results):
        off = max(peer["standard_errors_off"].values(), key=abs)
        rows.append(
            (
                name,
                _span(peer["rate"] / 1e6, [q / 1e6 for q in peer["rate_quartiles"]]),
                *(_ratio(peer, precision, quartiles=True) for precision in ("single", "mixed")),
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
            f"{race['reference_paths']} other paths, in standard errors."
        ),
    )


def scale_tables(results: dict) -> Iterator[Table]:
    """Yield how time and memory grow."""
    scales = results["scales"]
    yield Table(
        columns=("threads", "speed-up"),
        rows=[
            (row["threads"], _span(row["speed_up"], row["quartiles"])) for row in scales["threads"]
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
            (row["order"], row["nanoseconds"], _span(row["relative"], row["quartiles"]))
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


def records_table(results: dict) -> Table:
    """Return how many samples of a record are smoothed in a second."""
    records = results["records"]
    rows = [
        (
            name,
            _span(row["rate"] / 1e6, [q / 1e6 for q in row["rate_quartiles"]]),
            _span(row["ratio"], row["ratio_quartiles"]),
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
    measured = results["files"]
    rows = []
    for name, row in measured["paths"].items():
        rates = [_span(row[of] / 1e6, [q / 1e6 for q in row[f"{of}_quartiles"]]) for of in RATES]
        rows.append((name, *rates, _span(row["share"], row["share_quartiles"])))
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
    """Yield how long one sample takes, from Python and in C; an older record does not have it."""
    if "latency" not in results:
        return
    rows = []
    for name, row in results["latency"]["contenders"].items():
        times = [f"{each:.3g}" for each in row["nanoseconds"]]
        times += [""] * (3 - len(times))
        rows.append((name, *times, _span(row["ratio"], row["ratio_quartiles"])))
    yield Table(
        columns=("a sample by", "ns: median", "99%", "99.9%", "times as fast"),
        rows=rows,
        caption=(
            "The same smoother, a sample at a time, on one core: the time of a call from Python, "
            "or of one of many in a loop of C. Times as fast as the first row: medians of "
            f"{results['latency']['rounds']} interleaved rounds, with quartiles."
        ),
    )


def design_table(results: dict) -> Table:
    """Return how long a design and a sweep over its uncertainty take."""
    names = {
        "design": "a design at given multipliers",
        "sweep": "a sweep over 101 values of the uncertainty",
        "both": "both",
    }
    return Table(
        columns=("what", "ms"),
        rows=[(text, 1e3 * results["design"][key]) for key, text in names.items()],
        caption="A design of the example and its Fig. 4, after a first call: medians.",
        digits=2,
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


def _late(both: float) -> str:
    return f"design and sweep take {1e3 * both:.0f} ms; the aim is {1e3 * DESIGN_AIM:.0f} ms"


def words(results: dict) -> Iterator[str]:
    """Yield the scales, the records and the design in a sentence each."""
    scales = results["scales"]
    best = scales["threads"][-1]
    yield f"{best['threads']} threads are {best['speed_up']:.2f} times as fast as one."
    yield (
        f"Time grows as runs^{scales['runs']['exponent']:.2f} and "
        f"steps^{scales['steps']['exponent']:.2f}."
    )
    few, many = scales["memory"][0], scales["memory"][-1]
    yield (
        f"From {few['runs']:,} to {many['runs']:,} runs memory grows by "
        f"{many['megabytes'] - few['megabytes']:.1f} MB."
    )
    orders = scales["orders"][1:]
    yield (
        f"With a delay model of order {_listed(row['order'] for row in orders)} a step takes "
        f"{_listed(format(row['relative'], '.2f') for row in orders)} times as long as without."
    )
    call = scales["first_call"]
    yield (
        f"In a new process the first simulation answers in {call['call']:.2f} s, after an import "
        f"of {call['import']:.1f} s."
    )
    records = results["records"]["contenders"]
    ours, copies = records["robsmooth"], records["robsmooth, compiled copies"]
    yield (
        f"A record is smoothed at {ours['rate'] / 1e6:.0f} million samples a second, "
        f"{_span(records['scipy.signal.lfilter']['ratio'])} times SciPy's lfilter and "
        f"{_span(records['scipy.signal.dlsim']['ratio'])} times its dlsim; with compiled copies, "
        f"which lfilter cannot have, at {copies['rate'] / 1e6:.0f} million."
    )
    paths = results["files"]["paths"]
    csv, npy = (f"{paths[name]['rate'] / 1e6:.1f}" for name in ("csv to npy", "npy to npy"))
    yield (
        f"From file to file it is {csv} million rows a second from CSV, of which PyArrow alone "
        f"reads {paths['csv to npy']['reader'] / 1e6:.1f} million, and {npy} million from NPY."
    )
    waits = results["design"]
    yield (
        f"A design of the example takes {1e3 * waits['design']:.2g} ms, and a sweep over 101 "
        f"values of its uncertainty {1e3 * waits['sweep']:.2g} ms."
    )


def heading(results: dict) -> str:
    """Say where and when this was measured."""
    about = results["about"]
    machine, versions = about["machine"], about["versions"]
    cores = f"{machine['cores']} core" + ("s" if machine["cores"] > 1 else "")
    named = [f"{name} {versions[name]}" for name in ("numba", "numpy", "jax") if versions[name]]
    parts = [f"Python {versions['python']}", *named, about["compiler"] or "no C++ compiler"]
    return (
        f"{machine['processor']}, {cores}, {machine['platform']}; {', '.join(parts)}; "
        f"{about['written'][:10]}"
    )


def markdown(results: dict) -> str:
    """Return the whole report."""
    parts = [
        "# How fast the simulation is",
        "Written by `make bench`. The work is the paper's literal protocol: its loop with the "
        "printed smoother, Euler-Maruyama steps of 0.01 µs.",
        heading(results) + ".",
        peers_table(results).markdown(),
        "\n".join(f"- {text}" for text in remarks(results)),
        "## Scales",
        "![How time and memory grow](scaling.png)",
        *(table.markdown() for table in scale_tables(results)),
        "## Records",
        records_table(results).markdown(),
        files_table(results).markdown(),
        *(table.markdown() for table in latency_tables(results)),
        "## Design",
        design_table(results).markdown(),
        "## Guarantees",
        guarantees_table(results).markdown(),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


# --- the README ----------------------------------------------------------------------------------


def readme_block(results: dict) -> str:
    """Return what the README says."""
    rows = [
        (name, *(_ratio(peer, precision) for precision in ("single", "mixed")))
        for name, peer in _sorted_peers(results)
        if not name.startswith("robsmooth")
    ]
    table = Table(
        columns=("peer", "single", "mixed"),
        rows=rows,
        caption=(
            "How many times as fast robsmooth is on one core, by its precision: medians of "
            f"{results['race']['rounds']} interleaved rounds."
        ),
    )
    texts = [*words(results), *(f"Missed here: {text}." for text in shortfalls(results))]
    bullets = "\n".join(f"- {text}" for text in texts)
    return f"{table.markdown()}\n{bullets}\n\nMeasured on: {heading(results)}.\n"


def write_readme(readme: Path, results: dict) -> None:
    """Put the block between its marks."""
    text = readme.read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"{readme.name} must have the marks {BEGIN!r} and {END!r}")
    files.write_text(readme, f"{before}{begin}\n{readme_block(results)}{end}{after}")


def write(results: dict) -> None:
    """Write results.json, results.md, the figure and the README's block."""
    files.write_json(FOLDER / "results.json", results)
    files.write_text(FOLDER / "results.md", markdown(results))
    figures.use_style()
    figure = scaling(results)
    figures.save_figure(figure, FOLDER, "scaling")
    plt.close(figure)
    write_readme(FOLDER.parent / "README.md", results)


# --- the figure ----------------------------------------------------------------------------------


def scaling(results: dict) -> Figure:
    """Draw how time and memory grow."""
    scales = results["scales"]
    figure, ((runs, steps), (memory, orders)) = plt.subplots(2, 2, figsize=(6.0, 4.2))
    for axes, what in ((runs, "runs"), (steps, "steps")):
        thousands = [size / 1000 for size in scales[what][what]]
        axes.plot([0, thousands[-1]], [0, scales[what]["seconds"][-1]], color="0.4", linestyle=":")
        axes.plot(thousands, scales[what]["seconds"], "o", color="C0", linestyle="none")
        axes.set(xlabel=f"thousand {what}", ylabel="time (s)", xlim=(0, None), ylim=(0, None))
    memory.semilogx(
        [row["runs"] for row in scales["memory"]],
        [row["megabytes"] for row in scales["memory"]],
        "o-",
    )
    highest = max(row["megabytes"] for row in scales["memory"])
    memory.set(xlabel="runs", ylabel="peak memory (MB)", ylim=(0, 1.15 * highest))
    number = [row["order"] for row in scales["orders"]]
    orders.plot(number, [row["nanoseconds"] for row in scales["orders"]], "o-")
    orders.set(
        xlabel="order of the delay model",
        ylabel="time of a step (ns)",
        xticks=number,
        ylim=(0, None),
    )
    return figure


# --- helpers -------------------------------------------------------------------------------------


def _listed(values: Iterable) -> str:
    """Return "1, 2 and 3"."""
    *most, last = map(str, values)
    return f"{', '.join(most)} and {last}" if most else last


def _sorted_peers(results: dict) -> list[tuple[str, dict]]:
    return sorted(results["race"]["peers"].items(), key=lambda item: -item[1]["rate"])


def _ratio(peer: dict, precision: str, quartiles: bool = False) -> str:
    value = peer[f"ratio_{precision}"]
    return _span(value, peer[f"ratio_{precision}_quartiles"] if quartiles else None)


def _span(value: float, quartiles: list[float] | None = None) -> str:
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
