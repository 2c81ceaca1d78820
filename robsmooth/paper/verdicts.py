"""Whether the paper reproduces: every printed number is recomputed and judged."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np

from robsmooth._support import validation
from robsmooth._support.blas import one_thread
from robsmooth._support.tables import Table
from robsmooth.paper import published, statements

REPRODUCED = "reproduced"
WITH_FLIPPED_SIGN = "reproduced with the sign flipped"
NOT_REPRODUCED = "not reproduced"
NOT_CHECKABLE = "not checkable"
OUTCOMES = (REPRODUCED, WITH_FLIPPED_SIGN, NOT_REPRODUCED, NOT_CHECKABLE)
KINDS = ("input", "model", "optimum", "design", "sweep", "simulation")
Values = dict[str, float | validation.Matrix]  # recomputed, by the names of the quantities
_ZERO = 1e-9  # a smaller computed value is zero, relative to the largest entry of its matrix


@dataclass(frozen=True)
class Verdict:
    """One printed number or statement, and whether it reproduces.

    Attributes
    ----------
    name, place, printed : str
        Its name, e.g. ``"A_c[0, 1]"`` (from zero), its place in the paper, and its digits.
    value : float or str or None
        Recomputed, in the printed unit; words for a statement; None where nothing can be computed.
    relative_difference : float or None
        (value - printed)/abs(printed) for a printed number that is not zero.
    verdict, reason : str
        One of `OUTCOMES`, and why, if known, where it is not simply reproduced.
    """

    name: str
    place: str
    printed: str
    value: float | str | None
    relative_difference: float | None
    verdict: str
    reason: str


class Verdicts(list[Verdict]):
    """A list of verdicts; a notebook shows it as a table."""

    def __repr__(self) -> str:
        return f"Verdicts({self._counts})"

    def _repr_html_(self) -> str:
        return table(self, f"Verdicts: {self._counts}.", merge_zeros=True).html()

    @property
    def _counts(self) -> str:
        counts = Counter(verdict.verdict for verdict in self)
        return ", ".join(f"{counts[each]} {each}" for each in OUTCOMES if counts[each]) or "none"


@one_thread
def verdicts(data_dir: Path | str | None = None, kinds: Sequence[str] = KINDS) -> Verdicts:
    """Recompute every number that the paper prints and judge it.

    Parameters
    ----------
    data_dir : path, optional
        Folder with monte_carlo.json; by default the project's data/.
    kinds : sequence of str
        Kinds of quantities and statements to judge; by default all in data/published.toml.

    Returns
    -------
    list of Verdict
        In the paper's order, one for each entry of a matrix. A notebook shows a table.

    Raises
    ------
    ValueError
        For another kind, or where monte_carlo.json is missing or corrupt.
    """
    kinds = validation.sequence("kinds", kinds, of="words")
    for kind in kinds:
        validation.choice("kinds", kind, KINDS)
    folder = published.data_folder() if data_dir is None else validation.path("data_dir", data_dir)
    simulation, recompute = None, {"model": _model, "optimum": _optimum, "design": _design}
    if "simulation" in kinds:
        simulation = published.read_simulation(folder)
        names = "error covariance, smoother", "error covariance, NGCF"
        errors = statements.simulated_errors(simulation)
        recompute["simulation"] = lambda: [dict(zip(names, errors, strict=True))]
    recomputed = {kind: values() for kind, values in recompute.items() if kind in kinds}
    found, checks = Verdicts(), statements.checks(simulation)
    for entry in published.published()["quantity"]:
        if entry["kind"] in kinds:
            values = [each[entry["id"]] for each in recomputed.get(entry["kind"], [])]
            found.extend(_verdicts_on(entry, values))
    for entry in published.published()["statement"]:
        if entry["kind"] in kinds:
            holds, value, reason = checks[entry["id"]]()
            words = entry["id"], entry["place"], entry["text"], value, None
            found.append(Verdict(*words, REPRODUCED if holds else NOT_REPRODUCED, reason))
    return found


def table(verdicts: Iterable[Verdict], caption: str = "", merge_zeros: bool = False) -> Table:
    """Return the verdicts as a table; `merge_zeros` puts a matrix's reproduced zeros in one row."""
    groups: dict[str | int, list[Verdict]] = {}  # by the name of a matrix of zeros, or by number
    for number, verdict in enumerate(verdicts):
        found = verdict.printed.split(" ")[0], verdict.value, verdict.verdict
        zero = merge_zeros and found == ("0", 0.0, REPRODUCED)
        groups.setdefault(verdict.name.split("[")[0] if zero else number, []).append(verdict)
    rows = []
    for matrix, (first, *others) in groups.items():
        name = f"{matrix}, {1 + len(others)} zeros" if others else first.name
        rows.append((name, *astuple(first)[1:]))
    columns = ("what", "where", "printed", "ours", "relative difference", "verdict", "why")
    return Table(columns, rows, caption, digits=6)


def _model() -> list[Values]:
    plant = published.paper_plant()
    system, noise = plant.system, plant.D21_bar @ plant.D21_bar.T
    same = ("A_p", "C_p0", "B1_tilde", "C1_tilde", "D12_tilde", "C2_tilde", "D21_tilde", "D21_bar")
    values = {name: getattr(plant, name) for name in (*same, "J")}
    values |= {"B_p1": plant.B_p1[:, : system.q], "C_p2": plant.C2_tilde[:1]}
    values |= {"B_p1,1": plant.B1_tilde[:, :1], "Bbar_p1,1": plant.B1_tilde[:, 1:2]}
    values |= {"C_p1,1": plant.C1_tilde[:1], "Cbar_p1,1": plant.C1_tilde[1:2]}
    values |= {"g": system.g, "k": system.k, "k_tilde": len(plant.M_i)}
    values |= {"p": plant.C1_tilde.shape[0], "largest d_0": float(np.linalg.eigvalsh(noise).min())}
    values["h"] = sum(u.C.shape[0] for u in system.uncertainties)
    values["r"] = sum(u.B.shape[1] for u in system.uncertainties)
    return [values]


def _optimum() -> list[Values]:
    best = published.corrected_smoother()
    least = best.limit or best  # the infimum is not attained
    multipliers = dict(zip(published.LAMBDA, least.multipliers, strict=True))
    return [{"least V": least.bound, "tau": least.tau, **multipliers}]


def _design() -> list[Values]:
    """Return the values at the printed tau and lambda, then at corners that print the same."""
    found = []
    for tau, multipliers in published.rounding_box():
        estimator, bound = published.signed_design(tau, multipliers)
        matrices = {name: getattr(estimator, name) for name in ("A_c", "B_c", "C_c")}
        found.append(matrices | {"V at the printed tau, lambda": bound})
    return found


def _verdicts_on(entry: dict, values: Sequence[float | validation.Matrix]) -> Iterator[Verdict]:
    """Yield the verdict on each entry of a quantity; a number between its values must agree."""
    unit = f" {entry['unit']}" if "unit" in entry else ""
    for index, text in np.ndenumerate(np.array(entry["printed"], dtype=object)):
        name = entry["id"] + (str(list(index)) if index else "")
        quantity = name, entry["place"], text + unit
        if not values:
            reason = "an input of the paper, not a result"
            yield Verdict(*quantity, None, None, NOT_CHECKABLE, reason)
            continue
        candidates = [float(np.asarray(value)[index]) for value in values]
        zero = _ZERO * float(np.abs(values[0]).max())
        value = 0.0 if abs(candidates[0]) < zero else candidates[0]  # rounding differs by machine
        number = float(text)
        difference = (value - number) / abs(number) if number else None
        verdict, why = WITH_FLIPPED_SIGN if entry["kind"] == "design" else REPRODUCED, ""
        if not published.agrees(text, min(candidates), max(candidates), zero):
            verdict, why = NOT_REPRODUCED, entry["why"]
        yield Verdict(*quantity, value, difference, verdict, why)
