"""Measure everything, print it, and keep it where asked to."""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib import metadata

from benchmarks import report, scales
from benchmarks.design import design_and_sweep
from benchmarks.guarantees import guarantees
from benchmarks.peers import cpp
from robsmooth.workbench import provenance


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
    for table in (
        report.peers_table(results),
        *report.scale_tables(results),
        report.records_table(results),
        report.files_table(results),
        *report.latency_tables(results),
        report.design_table(results),
        report.guarantees_table(results),
    ):
        print(table)
    for text in report.skipped(results) if options.quick else report.remarks(results):
        print(text)
    if wrong := report.disagreeing(results):
        print(f"the results of {', '.join(wrong)} disagree with robsmooth's", file=sys.stderr)
        return 1
    if options.write:
        keep(results)
    return 0


def measure(quick: bool, peers: str) -> dict:
    """Race the peers and the records on one core, and then measure robsmooth's scales on all."""
    started, load = time.perf_counter(), os.getloadavg()[0]
    race = on_one_core("benchmarks.race", "--peers", peers, *(["--quick"] if quick else []))
    records = on_one_core("benchmarks.throughput", *(["--quick"] if quick else []))
    files = on_one_core("benchmarks.from_files", *(["--quick"] if quick else []))
    latency = on_one_core("benchmarks.latency", *(["--quick"] if quick else []))
    curves = scales.scales(scales.QUICK if quick else scales.FULL)
    waits = design_and_sweep(5 if quick else 31)
    certified = guarantees(1 if quick else 5)
    about = provenance.collect(started=started)
    about["load_before"] = load
    about["compiler"] = cpp.version()
    about["versions"] |= {name: version(name) for name in ("jax", "diffrax")}
    measured = {"race": race, "scales": curves, "records": records, "files": files}
    measured["latency"] = latency
    return {"about": about, **measured, "design": waits, "guarantees": certified}


def on_one_core(module: str, *arguments: str) -> dict:
    """Return what a module prints in a process of its own, which it keeps on one core."""
    command = [sys.executable, "-m", module, *arguments]
    return json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)


def keep(results: dict) -> None:
    """Write the results, where everybody took part who should have."""
    if report.is_complete(results):
        report.write(results)
        print("written: benchmarks/results.md, .json, scaling.*, and the README's block")
    else:
        wanted = ", ".join(name for name, _ in report.AIMS)
        print(f"nothing is written, because not all of these could be measured: {wanted}")


def version(package: str) -> str | None:
    """Return a package's version; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


if __name__ == "__main__":
    sys.exit(main())
