"""Measure everything, print it, and keep it where asked to."""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from importlib import metadata

from benchmarks import aims, history, machine, report, scales, tables
from benchmarks.any_loop import any_loop
from benchmarks.guarantees import guarantees
from benchmarks.peers import cpp
from benchmarks.targets import QUICK_STATES, STATES, import_time, targets
from robsmooth._support.tables import Table
from robsmooth.workbench import provenance

PACKAGES = ("jax", "diffrax", "dynamax", "filterpy", "stonesoup", "statsmodels", "slycot")
# Both compilers then make code for ordinary machines on one that has AVX-512.
AVX2 = dict.fromkeys(("NUMBA_CPU_NAME", cpp.OTHER_PROCESSOR), "x86-64-v3") | {
    "NUMBA_CPU_FEATURES": ""
}
ALONE = ("race", "throughput", "from_files", "kalman", "latency", "riccati", "growth")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return 1 where a peer's results disagree, else 0."""
    parser = argparse.ArgumentParser(prog="robsmooth bench", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="in seconds; ratios mean little")
    parser.add_argument("--write", action="store_true", help="write benchmarks/ and the README")
    parser.add_argument("--peers", default="", metavar="NAME[,NAME]", help="parts of their names")
    options = parser.parse_args(arguments)
    if options.write and (options.quick or options.peers):
        parser.error("--write wants everything measured: leave out --quick and --peers")

    results = measure(options.quick, options.peers)
    for table in printed(results):
        print(table)
    for text in aims.skipped(results) if options.quick else aims.remarks(results):
        print(text)
    if wrong := aims.disagreeing(results):
        print(f"the results of {', '.join(wrong)} disagree with robsmooth's", file=sys.stderr)
        return 1
    if options.write:
        keep(results)
    return 0


def printed(results: dict) -> Iterator[Table]:
    """Yield all tables."""
    yield tables.peers_table(results)
    yield from tables.scale_tables(results)
    yield tables.any_loop_table(results)
    yield tables.records_table(results)
    yield from tables.kalman_tables(results)
    yield tables.files_table(results)
    yield from tables.latency_tables(results)
    yield tables.riccati_table(results)
    yield tables.growth_table(results)
    yield tables.guarantees_table(results)
    yield from tables.cost_tables(results)
    yield tables.aims_table(results)
    yield tables.summary_table(results)


def measure(quick: bool, peers: str) -> dict:
    """Measure what wants one core in processes of their own, and the rest here, on all."""
    started, load = time.perf_counter(), os.getloadavg()[0]
    effort = ["--quick"] if quick else []
    results = {}
    for parts in [ALONE] if quick else [[part] for part in ALONE]:
        results |= in_own_process("alone", *parts, "--peers", peers, *effort)
    if machine.widest() == "avx512f" and not quick:
        narrow = in_own_process("alone", "race", "--peers", "C++", **AVX2)["race"]
        named = {name + machine.FOR_AVX2: peer for name, peer in narrow["peers"].items()}
        results["race"]["peers"] |= named
    results["processes"] = in_own_process("processes", *effort)
    results["any_loop"] = any_loop(quick)
    results["scales"] = scales.scales(scales.QUICK if quick else scales.FULL)
    waits = targets(1 if quick else 31, QUICK_STATES if quick else STATES)
    results["targets"] = [*waits, import_time(results["scales"]["first_call"]["import"])]
    results["guarantees"] = guarantees(*((1, 2) if quick else (5,)))
    about = provenance.collect(started=started)
    about["machine"] |= {"instructions": machine.instruction_set(), "blas": machine.blas()}
    about |= {"load_before": load, "compiler": cpp.version()}
    about["versions"] |= {name: version(name) for name in PACKAGES}
    results |= {"about": about}
    results["since"] = history.compared(history.figures(results), history.former(about["machine"]))
    return results


def in_own_process(module: str, *arguments: str, **environment: str) -> dict:
    """Return what a module of the benchmark prints in a process of its own."""
    command = [sys.executable, "-m", f"benchmarks.{module}", *arguments]
    how = {"stdout": subprocess.PIPE, "text": True, "check": True}
    return json.loads(subprocess.run(command, env=os.environ | environment, **how).stdout)


def keep(results: dict) -> None:
    """Write the results, where everybody took part who should have."""
    if aims.is_complete(results):
        report.write(results)
        print("written: benchmarks/results.md, .json, scaling.*, and the README's block")
        if aims.is_overloaded(results["about"]):
            print("not kept for later runs to compare with: the machine was too busy")
        else:
            path = history.keep(results["about"], history.figures(results))
            print(f"appended: benchmarks/history/{path.name}")
    else:
        wanted = ", ".join(name for name, _ in aims.RACE)
        print(f"nothing is written, because not all of these could be measured: {wanted}")


def version(package: str) -> str | None:
    """Return a package's version; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


if __name__ == "__main__":
    sys.exit(main())
