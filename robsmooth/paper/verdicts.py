r"""Whether the paper reproduces: every printed number recomputed and judged.

A value agrees with a printed one when rounding it, or cutting it off, at the printed digits gives
what is printed (the paper does both). What follows from the printed :math:`\tau` and
:math:`\lambda` agrees when it does so for some values that round to the printed ones.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.tables import Table
from robsmooth._support.validation import Matrix
from robsmooth.paper import statements
from robsmooth.paper.published import (
    agrees,
    corrected_smoother,
    data_folder,
    each_entry,
    flipped_design,
    paper_plant,
    printed,
    printed_multipliers,
    published,
    rounding_box,
)
from robsmooth.paper.results import MonteCarloTable

REPRODUCED = "reproduced"
WITH_FLIPPED_SIGN = "reproduced with the sign flipped"
NOT_REPRODUCED = "not reproduced"
NOT_CHECKABLE = "not checkable"
OUTCOMES = (REPRODUCED, WITH_FLIPPED_SIGN, NOT_REPRODUCED, NOT_CHECKABLE)

KINDS = ("input", "model", "optimum", "design", "sweep", "simulation")

_INPUT = "an input of the paper, not a result"
_ZERO = 1e-9  # relative to the largest entry of its matrix, a computed value below this is zero


@dataclass(frozen=True)
class Verdict:
    """One printed number or statement, and whether it reproduces.

    Attributes
    ----------
    name : str
        What it is, e.g. ``"A_c[0, 1]"`` (row and column from zero).
    place : str
        Where it stands in the paper.
    printed : str
        As printed.
    value : float or str or None
        Recomputed, in the printed unit; words for a statement; None where nothing can be computed.
    relative_difference : float or None
        Of value from printed, by the size of printed, where that makes sense.
    verdict : str
        One of "reproduced", "reproduced with the sign flipped", "not reproduced", "not checkable".
    reason : str
        Why, as far as known, where it does not simply reproduce.
    """

    name: str
    place: str
    printed: str
    value: float | str | None
    relative_difference: float | None
    verdict: str
    reason: str

    def __repr__(self) -> str:
        ours = self.value if isinstance(self.value, float) else None
        found = "" if ours is None else f", ours {ours:.6g}"
        return f"Verdict({self.name}: printed {_cut(self.printed)}{found}, {self.verdict})"


class Verdicts(list[Verdict]):
    """A list of verdicts, which a notebook shows as a table."""

    def __repr__(self) -> str:
        return f"Verdicts({self._counts})"

    def _repr_html_(self) -> str:
        return table(self, f"Verdicts: {self._counts}.", merge_zeros=True).html()

    @property
    def _counts(self) -> str:
        counts = Counter(verdict.verdict for verdict in self)
        found = [f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome]]
        return ", ".join(found) or "none"


@one_thread
def verdicts(data_dir: Path | str | None = None, kinds: Sequence[str] = KINDS) -> Verdicts:
    """Recompute every number that the paper prints and judge it.

    Parameters
    ----------
    data_dir : path, optional
        Folder with the Monte Carlo results, monte_carlo.json; by default the project's own data/,
        which `make figures` writes.
    kinds : sequence of str
        Which quantities and statements to judge, as data/published.toml sorts them; all by default.

    Returns
    -------
    list of Verdict
        In the order of the paper; a matrix gives one for each entry. A notebook shows it as a
        table.

    Raises
    ------
    ValueError
        Where a data file is missing or corrupt.
    """
    for kind in kinds:
        validation.choice("kinds", kind, KINDS)
    simulation = None
    if "simulation" in kinds:
        simulation = MonteCarloTable.read(Path(data_dir) if data_dir else data_folder())
    values = _Values(simulation)
    checks = statements.checks(simulation)
    found = Verdicts()
    for entry in published()["quantity"]:
        if entry["kind"] in kinds:
            found.extend(values.judge(entry))
    for statement in published()["statement"]:
        if statement["kind"] in kinds:
            holds, value, reason = checks[statement["id"]]()
            found.append(
                Verdict(
                    name=statement["id"],
                    place=statement["place"],
                    printed=statement["text"],
                    value=value,
                    relative_difference=None,
                    verdict=REPRODUCED if holds else NOT_REPRODUCED,
                    reason=reason,
                )
            )
    return found


def table(verdicts: Iterable[Verdict], caption: str = "", merge_zeros: bool = False) -> Table:
    """Return the verdicts as a table.

    Parameters
    ----------
    verdicts : iterable of Verdict
    caption : str
        What the table shows.
    merge_zeros : bool
        Whether the reproduced zeros of a matrix share one row.
    """
    rows = []
    for verdict in _merged(verdicts) if merge_zeros else verdicts:
        rows.append(
            (
                verdict.name,
                verdict.place,
                verdict.printed,
                verdict.value,
                verdict.relative_difference,
                verdict.verdict,
                verdict.reason,
            )
        )
    columns = ("what", "where", "printed", "ours", "relative difference", "verdict", "why")
    return Table(columns=columns, rows=rows, caption=caption, digits=6)


def _merged(verdicts: Iterable[Verdict]) -> Iterable[Verdict]:
    """Yield the verdicts with the reproduced zeros of each matrix as one."""

    def kind(verdict: Verdict) -> tuple[str, bool]:
        zero = verdict.printed.split(" ")[0] == "0" and verdict.value == 0.0
        zero = zero and verdict.verdict == REPRODUCED
        return (verdict.name.split("[")[0] if zero else verdict.name, zero)

    seen: dict[tuple[str, bool], list[Verdict]] = {}
    for verdict in verdicts:
        seen.setdefault(kind(verdict), []).append(verdict)
    for (name, zero), group in seen.items():
        first = group[0]
        if zero and len(group) > 1:
            yield Verdict(
                name=f"{name}, {len(group)} zeros",
                place=first.place,
                printed=first.printed,
                value=0.0,
                relative_difference=None,
                verdict=first.verdict,
                reason="",
            )
        else:
            yield first


class _Values:
    """The recomputed value of every printed quantity, each kind computed when first asked for."""

    def __init__(self, simulation: MonteCarloTable | None):
        self._simulation = simulation

    @cached_property
    def model(self) -> dict[str, float | Matrix]:
        plant = paper_plant()
        system = plant.system
        noise = plant.D21_bar @ plant.D21_bar.T
        return {
            "A_p": plant.A_p,
            "B_p1": plant.B_p1[:, : system.q],
            "B_p1,1": plant.B1_tilde[:, :1],
            "Bbar_p1,1": plant.B1_tilde[:, 1:2],
            "C_p0": plant.C_p0,
            "C_p1,1": plant.C1_tilde[:1],
            "Cbar_p1,1": plant.C1_tilde[1:2],
            "C_p2": plant.C2_tilde[:1],
            "B1_tilde": plant.B1_tilde,
            "C1_tilde": plant.C1_tilde,
            "D12_tilde": plant.D12_tilde,
            "C2_tilde": plant.C2_tilde,
            "D21_tilde": plant.D21_tilde,
            "D21_bar": plant.D21_bar,
            "h": sum(u.C.shape[0] for u in system.uncertainties),
            "r": sum(u.B.shape[1] for u in system.uncertainties),
            "p": plant.C1_tilde.shape[0],
            "k_tilde": len(plant.M_i),
            "g": system.g,
            "k": system.k,
            "J": plant.J,
            "largest d_0": float(np.linalg.eigvalsh(noise).min()),
        }

    @cached_property
    def optimum(self) -> dict[str, float | Matrix]:
        best = corrected_smoother()
        least = best.limit or best  # the infimum is not attained
        return {
            "least V": least.bound,
            "tau": least.tau,
            **{f"lambda_{i + 1}": float(least.multipliers[i]) for i in range(4)},
        }

    @cached_property
    def design(self) -> dict[str, float | Matrix]:
        return self._design_at(printed("tau"), printed_multipliers())

    @cached_property
    def simulation(self) -> dict[str, float | Matrix]:
        simulated = self._simulation
        return {
            "error covariance, smoother": simulated.mean_square("smoother, as printed", "smoothed"),
            "error covariance, NGCF": simulated.mean_square("NGCF", "filtered"),
        }

    @cached_property
    def _design_range(self) -> dict[str, tuple[Matrix, Matrix]]:
        """Return the least and largest values over all tau and lambda that print the same."""
        boxed = [self._design_at(*corner) for corner in rounding_box()]
        stacks = {name: np.array([values[name] for values in boxed]) for name in boxed[0]}
        return {name: (stack.min(axis=0), stack.max(axis=0)) for name, stack in stacks.items()}

    @staticmethod
    def _design_at(tau: float, multipliers: np.ndarray) -> dict[str, float | Matrix]:
        estimator, bound = flipped_design(tau, multipliers)
        return {
            "A_c": estimator.A_c,
            "B_c": estimator.B_c,
            "C_c": estimator.C_c,
            "V at the printed tau, lambda": bound,
        }

    def judge(self, entry: dict) -> Iterator[Verdict]:
        """Yield the verdict on a quantity, one for each entry of a matrix."""
        name, kind = entry["id"], entry["kind"]
        for index, text in each_entry(entry["printed"]):
            label = name + (f"[{index[0]}, {index[1]}]" if index else "")
            unit = f" {entry['unit']}" if "unit" in entry else ""
            common = {"name": label, "place": entry["place"], "printed": text + unit}
            if kind == "input":
                yield Verdict(
                    **common,
                    value=None,
                    relative_difference=None,
                    verdict=NOT_CHECKABLE,
                    reason=_INPUT,
                )
                continue
            whole = np.asarray(getattr(self, kind)[name], dtype=float)
            value = float(whole[index])
            ends = self._design_range[name] if kind == "design" else (whole, whole)
            low, high = (np.asarray(end)[index] for end in ends)
            zero = _ZERO * np.abs(whole).max()
            same = agrees(text, float(low), float(high), zero)
            value = 0.0 if abs(value) < zero else value  # rounding noise would differ by machine
            number = float(text)
            yield Verdict(
                **common,
                value=value,
                relative_difference=(value - number) / abs(number) if number else None,
                verdict=self._outcome(kind, same),
                reason="" if same else entry["why"],
            )

    @staticmethod
    def _outcome(kind: str, same: bool) -> str:
        if not same:
            return NOT_REPRODUCED
        return WITH_FLIPPED_SIGN if kind == "design" else REPRODUCED


def _cut(text: str, length: int = 40) -> str:
    return text if len(text) <= length else f"{text[: length - 3]}..."
