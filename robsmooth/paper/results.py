"""The Monte Carlo results on disk: monte_carlo.json, which notebook 04 writes."""

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from robsmooth._support import files
from robsmooth.homodyne.montecarlo import MonteCarloResult
from robsmooth.workbench import provenance

NEEDED = ("smoother, as printed", "NGCF", "Kalman-Bucy")  # the designs that verdicts are about
_NOT_RESULTS = ("wall_time", "provenance")


@dataclass(frozen=True)
class MonteCarloTable:
    """Mean square errors by design and output.

    Attributes
    ----------
    cases : dict
        From the name of the case to its "smoothed" and "filtered" results, each with
        "mean_square" and "standard_error".
    """

    cases: dict[str, dict[str, dict[str, float]]]

    NAME = "monte_carlo.json"

    @classmethod
    def read(cls, folder: Path) -> "MonteCarloTable":
        """Read monte_carlo.json; ValueError where it is missing or corrupt."""
        path = folder / cls.NAME
        try:
            cases = json.loads(path.read_text(encoding="utf-8"))["cases"]
            if missing := set(NEEDED) - set(cases):
                raise ValueError(f"no result for {', '.join(sorted(missing))}")
            for case in cases.values():
                for output in ("smoothed", "filtered"):
                    for field in ("mean_square", "standard_error"):
                        if not 0.0 <= case[output][field] < math.inf:
                            raise ValueError(f"{field} is not a finite number of at least zero")
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{path.name} in {folder.name}/ cannot be used ({type(error).__name__}: {error}); "
                "make figures ONLY=04 writes it anew"
            ) from None
        return cls(cases)

    def mean_square(self, design: str, output: str) -> float:
        """Return the mean square error of a case, rad^2."""
        return self.cases[design][output]["mean_square"]


def write(data: Path | str, results: Mapping[str, MonteCarloResult], seed: int) -> None:
    """Write the Monte Carlo results that the verdicts need, with their provenance beside them.

    The results file has nothing in it that differs from run to run.

    Parameters
    ----------
    data : path
        Folder to write monte_carlo.json to.
    results : mapping
        From the name of each design to its result.
    seed : int
        For the provenance.
    """
    path = Path(data) / MonteCarloTable.NAME
    cases = {}
    for name, result in results.items():
        case = result.to_dict()
        cases[name] = {key: value for key, value in case.items() if key not in _NOT_RESULTS}
    files.write_json(path, {"cases": cases})
    provenance.write(
        path,
        seed=seed,
        started=time.perf_counter() - sum(result.wall_time for result in results.values()),
        wall_time_seconds={name: round(result.wall_time, 3) for name, result in results.items()},
    )
