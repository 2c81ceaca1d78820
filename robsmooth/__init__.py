"""robsmooth: robust continuous-time fixed-lag smoothing for nonlinear uncertain systems."""

from robsmooth import homodyne
from robsmooth._support.errors import InfeasibleDesignError, UnstableLoopError
from robsmooth.analysis.constraints import AnalysisBound, analysis_bound
from robsmooth.analysis.covariance import delta_sweep, error_covariance, statistical_linearisation
from robsmooth.analysis.lag import LagChoice, LagSweep, best_lag, choose_lag, lag_sweep
from robsmooth.analysis.worst_case import (
    WorstCase,
    WorstDynamicCase,
    worst_case,
    worst_dynamic_case,
)
from robsmooth.estimators import baselines
from robsmooth.estimators.bound import minimize_bound
from robsmooth.estimators.discrete import DiscreteSmoother
from robsmooth.estimators.estimator import Estimator
from robsmooth.estimators.limit import limiting_smoother
from robsmooth.estimators.smoother import RobustSmoother, design_smoother
from robsmooth.homodyne.moments import StationaryErrors, stationary_errors
from robsmooth.homodyne.montecarlo import (
    LossOfLockWarning,
    MeanSquare,
    MonteCarloResult,
    monte_carlo,
)
from robsmooth.homodyne.study import Study, parameter_study
from robsmooth.io.designs import load, save
from robsmooth.io.records import smooth_record
from robsmooth.paper.verdicts import verdicts
from robsmooth.simulation.simulate import (
    InadmissibleWarning,
    SamplePaths,
    SimulatedError,
    SimulationResult,
    sample_paths,
    simulate,
)
from robsmooth.systems.augmented import AugmentedSystem, augment
from robsmooth.systems.system import Nonlinearity, UncertainSystem, Uncertainty

__all__ = [
    "AnalysisBound",
    "AugmentedSystem",
    "DiscreteSmoother",
    "Estimator",
    "InadmissibleWarning",
    "InfeasibleDesignError",
    "LagChoice",
    "LagSweep",
    "LossOfLockWarning",
    "MeanSquare",
    "MonteCarloResult",
    "Nonlinearity",
    "RobustSmoother",
    "SamplePaths",
    "SimulatedError",
    "SimulationResult",
    "StationaryErrors",
    "Study",
    "UncertainSystem",
    "Uncertainty",
    "UnstableLoopError",
    "WorstCase",
    "WorstDynamicCase",
    "analysis_bound",
    "augment",
    "baselines",
    "best_lag",
    "choose_lag",
    "delta_sweep",
    "design_smoother",
    "error_covariance",
    "homodyne",
    "lag_sweep",
    "limiting_smoother",
    "load",
    "minimize_bound",
    "monte_carlo",
    "parameter_study",
    "sample_paths",
    "save",
    "simulate",
    "smooth_record",
    "stationary_errors",
    "statistical_linearisation",
    "verdicts",
    "worst_case",
    "worst_dynamic_case",
]
