"""The whole public surface in use: type checkers must know what each thing is, and a run agrees."""

from pathlib import Path
from typing import Any, assert_type

import numpy as np
from numpy.typing import NDArray

import robsmooth as rs

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# --- systems, from what users have: lists, arrays, numbers ----------------------------------------

decay = rs.Uncertainty(B=[[1.0]], C=[[0.1]], D=[[0.0]])
gain = rs.Uncertainty([[0.0]], np.array([[0.05]]), ((1,),))
sine = rs.Nonlinearity([[0.0]], [[0.1]], [[1]], 1, np.sin)
A, B1, C0, C2, D21 = [[-1.0]], [[1.0, 0.0]], [[1.0]], [[1.0]], [[0.0, 0.1]]
system = rs.UncertainSystem(A, B1, C0, C2, D21, uncertainties=[decay, gain])
least_uncertain = rs.UncertainSystem(A, B1, C0, C2, D21, [gain])
loop = rs.UncertainSystem(A, B1, C0, C2, D21, (decay, gain), (sine for _ in range(1)))
sine_sector = rs.sector(np.sin, np.float64(1.2))
assert_type(sine_sector, rs.Sector)
assert_type(sine_sector.lower, float)
assert_type(sine_sector.nonlinearity([[0.0]], [[1.0]], [[1]], noise=0.1), rs.Nonlinearity)
assert_type(
    rs.Nonlinearity([[0]], [[1]], [[1]], sector=(0.6, 1)).sector, tuple[float, float] | None
)
assert_type(rs.sector(np.tanh, 1).half_width, float)
assert_type(rs.examples.random_walk(diffusion=2.0), rs.UncertainSystem)
assert_type(rs.examples.clock(), rs.UncertainSystem)
assert_type(rs.examples.resonant_phase(uncertainty=0.01), rs.UncertainSystem)
assert_type(decay, rs.Uncertainty)
assert_type(decay.B, Floats)
assert_type(sine.lipschitz, float)
assert_type(system, rs.UncertainSystem)
assert_type(system.A, Floats)
assert_type(system.uncertainties, tuple[rs.Uncertainty, ...])
assert_type(loop.nonlinearities, tuple[rs.Nonlinearity, ...])
assert_type(system.n, int)

plant = rs.augment(system, delay=0.2, order=2)
nonlinear = rs.augment(loop, 0.2, 2, J_21=[[1.0]])
small = rs.augment(least_uncertain, 0.2, 1)  # for what searches long
assert_type(plant, rs.AugmentedSystem)
assert_type(plant.A_p, Floats)
assert_type(plant.M_i, tuple[Floats, ...])
assert_type(plant.M([1.0, 2.0]), Floats)
assert_type(plant.delay, float)
assert_type(plant.order, int)
Delta = plant.structured_delta((0.5, [[-1.0]]))
assert_type(Delta, Floats)

controlled = rs.UncertainSystem.from_plant(
    system.to_statespace(), np.eye(4), 1.0, gain_uncertainty=0.1
)
assert_type(controlled, rs.UncertainSystem)

# --- estimators -----------------------------------------------------------------------------------

smoother = rs.minimize_bound(plant, cost="smoothed")
given = rs.design_smoother(plant, smoother.tau, smoother.multipliers, cost="smoothed")
limiting = rs.limiting_smoother(plant, given.tau, given.multipliers, "smoothed")
least = rs.minimax_smoother(plant, "filtered")
assert_type(least, rs.MinimaxSmoother)
assert_type(least.certified, float)
assert_type(least.route, str)
assert_type(smoother, rs.RobustSmoother)
assert_type(given, rs.RobustSmoother)
assert_type(limiting, rs.RobustSmoother)
assert_type(smoother.bound, float)
assert_type(smoother.bound_infimum, float | None)
assert_type(smoother.limit, rs.RobustSmoother | None)
assert_type(smoother.multipliers, Floats)
assert_type(smoother.A_c, Floats)
assert_type(smoother.poles, Complexes)
assert_type(smoother.plant, rs.AugmentedSystem)

classical = rs.baselines.fixed_lag_smoother(system, 0.2, 2)
assert_type(classical, rs.Estimator)
assert_type(rs.baselines.kalman_bucy(loop, copies=True), rs.Estimator)
assert_type(rs.baselines.worst_optimal_error(system, 0.2), float)
assert_type(rs.baselines.tuned_fixed_lag_smoother(small, "admissible", "filtered"), rs.Estimator)
for_constant = rs.constant_minimax_smoother(small, "filtered")
assert_type(for_constant, rs.ConstantMinimaxSmoother)
assert_type(for_constant.worst_constant, float)
choice_of = rs.best_smoother(small, against="constant")
assert_type(choice_of, rs.Choice)
assert_type(choice_of.estimator, rs.Estimator)
assert_type(choice_of.sentence, str)
assert_type(rs.judge(classical), rs.Judgement)
assert_type(rs.judge(classical, "filtered").certified, float)
assert_type(rs.baselines.ngcf(loop), rs.RobustSmoother)
assert_type(rs.baselines.optimal_fixed_lag_error(system, 0.2), Floats)
assert_type(rs.baselines.optimal_two_sided_error(system), Floats)

# --- records --------------------------------------------------------------------------------------

discrete = smoother.discretize(dt=1e-3)
filtering = classical.discretize(1e-3, delay="exact", mean=[0.0], offset=[0.0])
filtering.reset([0.0], covariance=[[1.0]])
assert_type(discrete, rs.DiscreteSmoother)
assert_type(discrete.run([[0.1], [0.2]]), Floats)
assert_type(filtering.run([[0.1]], return_std=True), tuple[Floats, Floats])
assert_type(filtering.two_sided([[0.1]]), tuple[Floats, Floats])
assert_type(discrete.step([0.3]), Floats)
assert_type(discrete.times(3, "filtered"), Floats)
assert_type(discrete.filtered, Floats)
assert_type(discrete.samples, int)
assert_type(discrete.compiled, bool)
assert_type(discrete.exact, bool)
checked = rs.check_record(filtering, np.zeros((30, 1)))
assert_type(checked, rs.RecordCheck)
assert_type(checked.mean_square, float)
assert_type(checked.sentence, str)
np.save("record.npy", np.ones((10, 1)))
assert rs.smooth_record(discrete, "record.npy", Path("smoothed.npy")) == 10
np.savetxt("record.csv", np.ones((10, 1)))
assert rs.smooth_record(discrete, "record.csv", "smoothed.csv", header=False) == 10
assert rs.smooth_record(discrete, "record.csv", "w.tsv", time=False, header=False, resume=True)
assert rs.smooth_record(discrete, np.ones((10, 1))).shape == (10, 1)
assert len(rs.smooth_record(filtering, np.ones((10, 1)), return_std=True)) == 2
rs.save(smoother, "smoother.toml")
loaded = rs.load(Path("smoother.toml"), functions={})
assert_type(loaded, rs.UncertainSystem | rs.AugmentedSystem | rs.Estimator | rs.DiscreteSmoother)

# --- errors of an estimator -----------------------------------------------------------------------

assert_type(rs.error_covariance(smoother, Delta), Floats)
swept = rs.delta_sweep(rs.baselines.ngcf(loop), [-1.0, 0.0], "filtered")
assert_type(swept.covariances, Floats)
assert_type(swept.mean_square, Floats)
half = np.asarray(swept) / 2
swept.to_frame()
worst = rs.worst_case(smoother)
assert_type(worst, rs.WorstCase)
assert_type(worst.Delta, Floats)
assert_type(worst.mean_square, float)
certified = rs.analysis_bound(smoother)
assert_type(certified, rs.AnalysisBound)
assert_type(certified.mean_square, float)
assert_type(certified.multipliers, Floats)

sweep = rs.lag_sweep(system, [0.1, 0.2], [1, 2])
assert_type(sweep, rs.LagSweep)
assert_type(sweep.nominal, Floats)
assert_type(sweep.optimal, Floats)
assert_type(rs.lag_sweep(system, np.array([0.1]), np.array([1])).worst, Floats)
assert_type(rs.best_lag(system, 1), tuple[float, float])
choice = rs.choose_lag(system, fraction=0.5)
assert_type(choice, rs.LagChoice)
assert_type(choice.order, int)
assert_type(choice.lag, float)

# --- simulations ----------------------------------------------------------------------------------

simulated = rs.simulate(smoother, uncertainties=[0.5, lambda t, zeta: -zeta], runs=4, duration=1.0)
assert_type(simulated, rs.SimulationResult)
assert_type(simulated.smoothed, rs.MeanSquare)
paths = rs.sample_paths(smoother, runs=2, duration=1.0)
assert_type(paths, rs.SamplePaths)
assert_type(paths.w, Floats)

# --- the paper's example --------------------------------------------------------------------------

paper = rs.homodyne.PAPER
assert_type(paper, rs.homodyne.HomodyneParameters)
assert_type(paper.uncertain_system(), rs.UncertainSystem)
assert_type(paper.with_gain(0.5), rs.homodyne.HomodyneParameters)
kalman = rs.baselines.kalman_bucy(paper.uncertain_system(), copies=True)
linearised = rs.statistical_linearisation(paper, kalman)
assert_type(linearised.filtered, float)
stationary = rs.stationary_errors(paper, kalman)
assert_type(stationary, rs.StationaryErrors)
assert_type(stationary.smoothed, float)
result = rs.monte_carlo(paper, kalman, runs=128, client=None, checkpoint=Path("mc.txt"))
assert_type(result, rs.MonteCarloResult)
assert_type(result.smoothed, rs.MeanSquare)
assert_type(result.smoothed.mean_square, float)
assert_type(result.provenance, dict[str, Any])
study = rs.parameter_study(paper, [1e-6], [2], [0.4], [1.0], runs=128)
assert_type(study, rs.Study)
assert_type(study.ratio, Floats)

found = rs.verdicts(kinds=["model"])
assert_type(found[0].verdict, str)
assert_type(found[0].value, float | str | None)

# --- errors and warnings --------------------------------------------------------------------------

for warning in (
    rs.CoarseDelayWarning,
    rs.InadmissibleWarning,
    rs.LongStepWarning,
    rs.LossOfLockWarning,
):
    assert issubclass(warning, Warning)
try:
    rs.design_smoother(plant, 1e-9, [1.0, 1.0])
except rs.InfeasibleDesignError as error:
    assert_type(error.condition, str)
except rs.UnstableLoopError:
    raise
assert_type(rs.__version__, str)
