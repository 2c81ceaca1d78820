"""robsmooth: robust continuous-time fixed-lag smoothing for nonlinear uncertain systems."""

from robsmooth import baselines, homodyne
from robsmooth.augmented import AugmentedSystem, augment
from robsmooth.bound import minimize_bound
from robsmooth.covariance import delta_sweep, error_covariance, statistical_linearisation
from robsmooth.errors import InfeasibleDesignError, UnstableLoopError
from robsmooth.estimator import Estimator
from robsmooth.galerkin import StationaryErrors, stationary_errors
from robsmooth.montecarlo import LossOfLockWarning, MeanSquare, MonteCarloResult, monte_carlo
from robsmooth.reproduction import verdicts
from robsmooth.smoother import RobustSmoother, design_smoother
from robsmooth.study import Study, parameter_study
from robsmooth.systems import Nonlinearity, UncertainSystem, Uncertainty

__all__ = [
    "AugmentedSystem",
    "Estimator",
    "InfeasibleDesignError",
    "LossOfLockWarning",
    "MeanSquare",
    "MonteCarloResult",
    "Nonlinearity",
    "RobustSmoother",
    "StationaryErrors",
    "Study",
    "UncertainSystem",
    "Uncertainty",
    "UnstableLoopError",
    "augment",
    "baselines",
    "delta_sweep",
    "design_smoother",
    "error_covariance",
    "homodyne",
    "minimize_bound",
    "monte_carlo",
    "parameter_study",
    "stationary_errors",
    "statistical_linearisation",
    "verdicts",
]
