"""Parts of the benchmark in a process that is kept on one core; it prints JSON.

The process is put there before any library has started its threads, so this imports none before.
Run as ``python -m benchmarks.alone PART [PART ...]``, with the names of modules.
"""

import argparse
import importlib
import json
import os

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def pin() -> bool:
    """Keep this process on one core, and its libraries on one thread; tell whether it worked."""
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    try:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    except (AttributeError, OSError):  # not a Linux
        return False
    return True


def main() -> None:
    """Measure the parts, and print a dict of what came out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="+", metavar="PART")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--peers", default="", help="parts of names, with commas (default: all)")
    options = parser.parse_args()
    pinned = pin()
    found = {}
    for part in options.parts:
        module = importlib.import_module(f"benchmarks.{part}")
        found[part] = {"pinned": pinned, **module.measure(options.quick, options.peers)}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
