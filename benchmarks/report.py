"""The results in words, tables and a figure, and in the README."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks import tables
from benchmarks.aims import remarks, shortfalls
from benchmarks.tables import ratio, span
from robsmooth._support import files
from robsmooth.paper import figures

FOLDER = Path(__file__).parent
BEGIN, END = "<!-- bench: written by make bench -->", "<!-- end of bench -->"


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
    *_, fastest = results["any_loop"]["contenders"].values()
    yield (
        f"Any other loop is simulated at {fastest['rate'] / 1e6:.0f} million steps a second, "
        f"{span(fastest['ratio'])} times the same scheme in NumPy."
    )
    records = results["throughput"]["contenders"]
    ours, copies = records["robsmooth"], records["robsmooth, compiled copies"]
    yield (
        f"A record is smoothed at {ours['rate'] / 1e6:.0f} million samples a second, "
        f"{span(records['scipy.signal.lfilter']['ratio'])} times SciPy's lfilter and "
        f"{span(records['scipy.signal.dlsim']['ratio'])} times its dlsim; with compiled copies, "
        f"which lfilter cannot have, at {copies['rate'] / 1e6:.0f} million."
    )
    paths = results["from_files"]["paths"]
    csv, npy = (f"{paths[name]['rate'] / 1e6:.1f}" for name in ("csv to npy", "npy to npy"))
    yield (
        f"From file to file it is {csv} million rows a second from CSV, of which PyArrow alone "
        f"reads {paths['csv to npy']['reader'] / 1e6:.1f} million, and {npy} million from NPY."
    )
    lag = results["kalman"]["uses"]["at a fixed lag"]
    peers = {name.split(",")[0]: row for name, row in lag.items() if "delay line" in name}
    if peers:
        named = [f"{span(row['ratio'])} times {name}'s" for name, row in peers.items()]
        ours = lag["robsmooth, at a fixed lag"]["rate"] / 1e6
        yield (
            f"With its exact delay it is smoothed at {ours:.1f} million, "
            f"{_listed(named)} Kalman filter with a delay line."
        )
    yield waits(results)


def waits(results: dict) -> str:
    """Say how long one waits for a design, a sweep and a simulation."""
    measured = {row["name"]: row["measured"] for row in results["targets"]}
    design, sweep, answer = (
        1e3 * next(value for name, value in measured.items() if name.startswith(start))
        for start in ("design_smoother", "delta_sweep", "monte_carlo")
    )
    return (
        f"A design of the example takes {design:.2g} ms, a sweep over 101 values of its "
        f"uncertainty {sweep:.2g} ms, and the default answer of the Monte Carlo {answer:.2g} ms."
    )


def heading(results: dict) -> str:
    """Say where and when this was measured."""
    about = results["about"]
    machine, versions = about["machine"], about["versions"]
    cores = f"{machine['cores']} core" + ("s" if machine["cores"] > 1 else "")
    named = [f"{name} {versions[name]}" for name in ("numba", "numpy", "jax") if versions[name]]
    parts = [f"Python {versions['python']}", *named, about["compiler"] or "no C++ compiler"]
    return (
        f"{machine['processor']} ({machine['instructions']}), {cores}, BLAS {machine['blas']}, "
        f"{machine['platform']}; {', '.join(parts)}; {about['written'][:10]}"
    )


def since(results: dict) -> Iterator[str]:
    """Yield the comparison with the last run on a machine of this kind, if there was one."""
    if results["since"]["rows"]:
        yield "## Since the last run"
        yield tables.since_table(results).markdown()


def markdown(results: dict) -> str:
    """Return the whole report."""
    found = "\n".join(f"- {text}" for text in remarks(results))
    parts = [
        "# How fast it is",
        f"Written by `make bench`, on {heading(results)}.",
        tables.aims_table(results).markdown(),
        found,
        "\n".join(f"- {text}" for text in words(results)),
        tables.summary_table(results).markdown(),
        *since(results),
        "## The simulation",
        "The paper's literal protocol: its loop with the printed smoother, Euler-Maruyama steps of "
        "0.01 µs.",
        tables.peers_table(results).markdown(),
        "![Time grows in proportion to runs and to steps, memory does not grow with runs, and the "
        "time of a step grows with the order of the delay model](scaling.png)",
        *(table.markdown() for table in tables.scale_tables(results)),
        tables.any_loop_table(results).markdown(),
        "## Records",
        tables.records_table(results).markdown(),
        *(table.markdown() for table in tables.kalman_tables(results)),
        tables.files_table(results).markdown(),
        *(table.markdown() for table in tables.latency_tables(results)),
        "## Designs",
        tables.riccati_table(results).markdown(),
        tables.growth_table(results).markdown(),
        tables.guarantees_table(results).markdown(),
        "## Past one machine",
        *(table.markdown() for table in tables.cost_tables(results)),
    ]
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


# --- the README ----------------------------------------------------------------------------------


def readme_block(results: dict) -> str:
    """Return what the README says: the simulation, records, and designs."""
    peers, missed = results["race"]["peers"], shortfalls(results)
    records = results["throughput"]["contenders"]
    csv = results["from_files"]["paths"]["csv to npy"]["rate"]
    exact = results["kalman"]["uses"]["at a fixed lag"]["robsmooth, at a fixed lag"]["rate"]
    aims = f"{len(missed)} aims" if len(missed) != 1 else "1 aim"
    texts = (
        f"One core simulates the paper's example {ratio(peers['C++, single'], 'single')} times as "
        f"fast as C++ and {ratio(peers['NumPy, float32'], 'single')} times as fast as NumPy.",
        f"With a model of its delay a record is smoothed at "
        f"{records['robsmooth']['rate'] / 1e6:.0f} million samples a "
        f"second from memory, and at {csv / 1e6:.1f} million from CSV to NPY; with its exact "
        f"delay, the default of a classical design, at {exact / 1e6:.1f} million from memory.",
        f"{waits(results)} [The bench](benchmarks/results.md) has all measurements and the {aims} "
        "that they miss.",
    )
    return "".join(f"- {text}\n" for text in texts)


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
