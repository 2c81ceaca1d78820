"""How many rows a second `smooth_record` takes from file to file, beside what only reads the file.

The smoother is the fixed-lag smoother of the example with its delay model, of one measurement.
PyArrow in one thread reads CSV and Parquet, NumPy reads NPY. Run as
``python -m benchmarks.alone from_files``.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.race import middle, say
from benchmarks.throughput import DT, FULL, QUICK

PATHS = (("csv", "csv"), ("csv", "npy"), ("npy", "npy"), ("parquet", "npy"))
MOST = 1_000_000  # rows


def readers() -> dict[str, Callable[[Path], None]]:
    """Return what reads a file of each kind to its end, in pieces, and does nothing with them."""
    import numpy as np
    from pyarrow import csv, parquet

    def read_csv(path):
        for _ in csv.open_csv(path, csv.ReadOptions(use_threads=False)):
            pass

    def read_npy(path):
        mapped = np.load(path, mmap_mode="r")
        for i in range(0, len(mapped), 65_536):
            mapped[i : i + 65_536].astype(float)

    def read_parquet(path):
        for _ in parquet.ParquetFile(path).iter_batches():
            pass

    return {"csv": read_csv, "npy": read_npy, "parquet": read_parquet}


def from_files(rounds: int, rows: int) -> dict:
    """Measure all, interleaved; the share is of the reader's rate, in the same round."""
    import numpy as np
    import pyarrow as pa
    from pyarrow import parquet

    from robsmooth import homodyne, smooth_record
    from robsmooth.estimators import baselines
    from robsmooth.paper.published import DELAY

    system = homodyne.PAPER.uncertain_system()
    smoother = baselines.fixed_lag_smoother(system, DELAY, 2).discretize(DT, delay="model")
    y = np.random.default_rng(0).standard_normal((rows, 1))
    found = {f"{source} to {target}": [] for source, target in PATHS}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "y"
        np.save(file.with_suffix(".npy"), y)
        np.savetxt(file.with_suffix(".csv"), y, header="y", comments="")
        parquet.write_table(pa.table({"y": y[:, 0]}), file.with_suffix(".parquet"))
        for number in range(rounds + 1):  # the first one fills caches, and is left out
            say(f"from file to file: round {number} of {rounds}")
            reading = {
                kind: timed(lambda: read(file.with_suffix(f".{kind}")))  # noqa: B023
                for kind, read in readers().items()
            }
            for source, target in PATHS:
                paths = file.with_suffix(f".{source}"), Path(folder) / f"w.{target}"
                smoother.reset()
                seconds = timed(lambda: smooth_record(smoother, *paths))  # noqa: B023
                found[f"{source} to {target}"].append((rows / seconds, rows / reading[source]))
    measured = {}
    for name, rates in found.items():
        ours, limit = np.transpose(rates[1:])
        measured[name] = dict(zip(("rate", "rate_quartiles"), middle(ours), strict=True))
        measured[name] |= dict(zip(("reader", "reader_quartiles"), middle(limit), strict=True))
        measured[name] |= dict(zip(("share", "share_quartiles"), middle(ours / limit), strict=True))
    return {"rounds": rounds, "rows": rows, "paths": measured}


def timed(call: Callable[[], object]) -> float:
    """Return how long a call takes, in s."""
    started = time.perf_counter()
    call()
    return time.perf_counter() - started


def measure(quick: bool, _peers: str) -> dict:
    """Measure as much as for a test of the benchmarks, or all."""
    return from_files((QUICK if quick else FULL).rounds, MOST // 50 if quick else MOST)
