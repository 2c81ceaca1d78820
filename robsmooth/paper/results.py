"""The Monte Carlo results on disk: monte_carlo.json, which notebook 04 writes."""

import json
import math
import time
from collections.abc import Mapping
from pathlib import Path

from robsmooth._support import files
from robsmooth.homodyne.montecarlo import MeanSquare, MonteCarloResult
from robsmooth.workbench import provenance

FILE = "monte_carlo.json"
NEEDED = ("smoother, as printed", "NGCF", "Kalman-Bucy")  # the designs that verdicts are about
_NOT_RESULTS = ("wall_time", "provenance")

# From the name of a design to its "smoothed" and its "filtered" error.
SimulatedErrors = Mapping[str, Mapping[str, MeanSquare]]


def read(folder: Path) -> SimulatedErrors:
    """Read the mean square errors of a folder; ValueError where the file is missing or corrupt."""
    try:
        cases = json.loads((folder / FILE).read_text(encoding="utf-8"))["cases"]
        if missing := set(NEEDED) - set(cases):
            raise ValueError(f"no result for {', '.join(sorted(missing))}")
        return {
            name: {output: _mean_square(case[output]) for output in ("smoothed", "filtered")}
            for name, case in cases.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{FILE} in {folder.name}/ cannot be used ({type(error).__name__}: {error}); "
            "make figures ONLY=04 writes it anew"
        ) from None


def _mean_square(stored: Mapping[str, float]) -> MeanSquare:
    for field in ("mean_square", "standard_error"):
        if not 0.0 <= stored[field] < math.inf:
            raise ValueError(f"{field} is not a finite number of at least zero")
    return MeanSquare(stored["mean_square"], stored["standard_error"])


def write(data: Path | str, results: Mapping[str, MonteCarloResult], seed: int) -> None:
    """Write what does not differ from run to run to a folder, and the provenance beside it."""
    path = Path(data) / FILE
    cases = {
        name: {key: value for key, value in result.to_dict().items() if key not in _NOT_RESULTS}
        for name, result in results.items()
    }
    files.write_json(path, {"cases": cases})
    times = {name: round(result.wall_time, 3) for name, result in results.items()}
    started = time.perf_counter() - sum(times.values())
    provenance.write(path, seed=seed, started=started, wall_time_seconds=times)
