"""Run the Monte Carlo: check the arguments, simulate, and say what was found."""

import hashlib
import os
import time
import warnings
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from robsmooth._support import cluster, validation
from robsmooth._support.checkpoint import open_journal
from robsmooth.estimators.estimator import Estimator
from robsmooth.homodyne.loop import homodyne_loop
from robsmooth.homodyne.montecarlo.protocols import PROTOCOLS, plan
from robsmooth.homodyne.parameters import HomodyneParameters
from robsmooth.simulation.groups import tally_paths
from robsmooth.simulation.noise import GENERATOR
from robsmooth.simulation.statistics import MeanSquare


class LossOfLockWarning(RuntimeWarning):
    """Some paths slipped: their errors depend on the duration, those in lock do not."""


@dataclass(frozen=True)
class MonteCarloResult(validation.Frozen):
    """Mean square errors of the filter and the smoother in the nonlinear loop, by `monte_carlo`.

    Attributes
    ----------
    smoothed, filtered : MeanSquare
        Over all paths, rad^2; a path that has slipped counts with its error of whole turns.
    smoothed_in_lock, filtered_in_lock : MeanSquare
        Over the paths that never slipped, rad^2, without control variates.
    slips, slipped_paths : int, changes to the next point where the loop locks; paths with any
    runs, path_steps : int, independent paths; steps of all of them, the warm-up included
    protocol, seed, precision : str, int, str, as asked for
    duration, warm_up, step, wall_time : float
        Time of a path that is sampled, time before, step, and computing time, s.
    provenance : dict, everything else that the numbers depend on, in a JSON form
    """

    smoothed: MeanSquare
    filtered: MeanSquare
    smoothed_in_lock: MeanSquare
    filtered_in_lock: MeanSquare
    slips: int
    slipped_paths: int
    runs: int
    path_steps: int
    wall_time: float
    protocol: str
    duration: float
    warm_up: float
    step: float
    seed: int
    precision: str
    provenance: dict[str, Any] = field(repr=False)

    @property
    def slip_rate(self) -> float:
        """Cycle slips a second of a path, 1/s."""
        return self.slips / (self.path_steps * self.step)

    def to_dict(self) -> dict[str, Any]:
        """All fields as a dict that the json module writes; NaN becomes None."""
        # NaN does not equal itself
        return asdict(self, dict_factory=lambda items: {k: v if v == v else None for k, v in items})

    def __repr__(self) -> str:
        slips = "no slips"
        if self.slips:
            errors = f"in lock {self.smoothed_in_lock} and {self.filtered_in_lock} rad^2"
            slips = f"{self.slips} slips in {self.slipped_paths} of {self.runs} paths, {errors}"
        return (
            f"MonteCarloResult(smoothed {self.smoothed} rad^2, filtered {self.filtered} rad^2; "
            f"{slips}; {self.protocol}: {self.runs} runs of "
            f"{self.duration:.4g} s, step {self.step:.4g} s, seed {self.seed}, {self.precision}; "
            f"{self.path_steps:.3g} path-steps in {self.wall_time:.2g} s)"
        )


def monte_carlo(
    parameters: HomodyneParameters,
    smoother: Estimator,
    protocol: str = "ergodic",
    runs: int | None = None,
    duration: float | None = None,
    step: float | None = None,
    seed: int = 0,
    precision: str = "mixed",
    client: "cluster.Client | None" = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool = False,
    *,
    oscillator: str = "filtered",
    copy: bool = True,
    shot_noise: float = 1.0,
) -> MonteCarloResult:
    r"""Simulate an estimator in the homodyne loop of Section IV and measure its errors.

    The result is the same, to the last bit, for any number of threads (numba's setting), on a
    cluster, and after an interruption. The noise of a path depends on the seed and its index alone.

    Parameters
    ----------
    parameters : HomodyneParameters, of the loop; the estimator may be made for others
    smoother : Estimator, of one output and one measurement, with one copy or none
    protocol : {"ergodic", "paper"}
        "paper" is the published simulation: Euler-Maruyama from zero, the squared errors at the end
        of each run. "ergodic" gives the stationary errors in far less time: it averages along each
        path, with steps of the second order and the linearised loop as a control variate.
    runs : int, optional, independent paths; 50 000 ("paper") or 1024 ("ergodic") by default
    duration : float, optional
        Of a path, without the warm-up, s; rounded to whole steps. Default: 1 ms ("paper") or 250
        times the slowest time constant of the linearised estimator ("ergodic").
    step : float, optional
        s; must divide the smoother's delay. Default: the largest such step that is at most 0.01 us
        ("paper") or a fifth of the loop's response time ("ergodic").
    seed : int, at least 0 and below 2^64
    precision : {"mixed", "single"}, of the state: double or single; noise is drawn in single
    client : distributed.Client, optional, of a Dask cluster; see `robsmooth.workbench.connect`
    checkpoint : path, optional, of a file from which the same call resumes
    progress : bool, show a progress bar
    oscillator : {"filtered", "smoothed", "copy", "none"}
        The local oscillator's phase u: an estimate; the argument of the copy,
        :math:`\tilde\nu/2\alpha\gamma`, so that the copy's output is zero; or zero. With zero the
        nonlinearity is :math:`f(\phi)`, as in the words of Section IV-E, and not
        :math:`f(\phi - u)`, as in Section IV-A; slips are then of the filtered estimate.
    copy : bool, run the estimator's copy of the nonlinearity; otherwise its output is zero
    shot_noise : float, power of the photocurrent's noise, :math:`s` in :math:`\sqrt s\,dW`

    Warns
    -----
    LossOfLockWarning, LongStepWarning
        Where a path slipped; where a step is above 1/40 ("paper") or 1/4 ("ergodic") response time.

    Raises
    ------
    ValueError
        For an unstable Euler step ("paper"), or a checkpoint of another call (CheckpointError).
    UnstableLoopError, RuntimeError
        Where the linearised loop is unstable ("ergodic"); where a path overflows, or numba is off.
    ConnectionError, OSError
        Where the cluster is lost; where the checkpoint cannot be written.

    Examples
    --------
    >>> kalman = rs.baselines.kalman_bucy(rs.homodyne.PAPER.uncertain_system())
    >>> result = rs.monte_carlo(rs.homodyne.PAPER, kalman, runs=256)
    >>> print(f"{result.filtered.mean_square:.3f} rad^2, {result.slips} slips")
    0.088 rad^2, 0 slips
    """
    started = time.perf_counter()
    validation.choice("protocol", protocol, tuple(PROTOCOLS))
    loop = homodyne_loop(parameters, smoother, oscillator, copy, shot_noise)
    planned = plan(loop, protocol, runs, duration, step, seed, precision)
    simulation = replace(planned, parameters=dict(vars(parameters)))
    progress = validation.boolean("progress", progress)
    inputs = {"parameters": simulation.parameters, "delay": loop.delay, "oscillator": oscillator}
    inputs |= {"copy": bool(copy), "shot_noise": float(shot_noise)}
    matrices = [getattr(smoother, name).tolist() for name in ("A_c", "B_c", "C_c", "C_a", "C_f")]
    inputs["estimator_sha256"] = hashlib.sha256(repr(matrices).encode()).hexdigest()
    names = ("runs", "seed", "precision", "step", "warm_up", "duration")
    settings = {"protocol": protocol, **{name: getattr(simulation, name) for name in names}}
    identity = {**settings, **inputs, "software": cluster.software()}
    with open_journal(checkpoint, identity) as journal:
        tally = tally_paths(simulation, journal, client, progress)

    slipped = tally.all.count - tally.locked.count
    if slipped:
        warnings.warn(
            f"the loop lost lock: {tally.slips} cycle slips in {slipped} of "
            f"{simulation.runs} paths, whose errors of whole turns are in the mean squares",
            LossOfLockWarning,
            stacklevel=2,
        )
    return MonteCarloResult(
        smoothed=tally.all.mean_square(-1, plain=1),
        filtered=tally.all.mean_square(-2, plain=0),
        filtered_in_lock=tally.locked.mean_square(0),
        smoothed_in_lock=tally.locked.mean_square(1),
        slips=tally.slips,
        slipped_paths=slipped,
        path_steps=simulation.runs * simulation.steps,
        wall_time=time.perf_counter() - started,
        **settings,
        provenance={**inputs, "generator": GENERATOR, "versions": identity["software"]},
    )
