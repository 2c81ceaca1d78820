"""The public names, for type checkers and for `__init__`, which imports by this list."""

from robsmooth import homodyne as homodyne
from robsmooth._support.errors import CoarseDelayWarning as CoarseDelayWarning
from robsmooth._support.errors import InfeasibleDesignError as InfeasibleDesignError
from robsmooth._support.errors import LongStepWarning as LongStepWarning
from robsmooth._support.errors import UnstableLoopError as UnstableLoopError
from robsmooth.analysis.choice import Choice as Choice
from robsmooth.analysis.choice import Judgement as Judgement
from robsmooth.analysis.choice import best_smoother as best_smoother
from robsmooth.analysis.choice import judge as judge
from robsmooth.analysis.constraints import AnalysisBound as AnalysisBound
from robsmooth.analysis.constraints import analysis_bound as analysis_bound
from robsmooth.analysis.covariance import WorstCase as WorstCase
from robsmooth.analysis.covariance import delta_sweep as delta_sweep
from robsmooth.analysis.covariance import error_covariance as error_covariance
from robsmooth.analysis.covariance import worst_case as worst_case
from robsmooth.analysis.lag import LagChoice as LagChoice
from robsmooth.analysis.lag import LagSweep as LagSweep
from robsmooth.analysis.lag import best_lag as best_lag
from robsmooth.analysis.lag import choose_lag as choose_lag
from robsmooth.analysis.lag import lag_sweep as lag_sweep
from robsmooth.analysis.record_check import RecordCheck as RecordCheck
from robsmooth.analysis.record_check import check_record as check_record
from robsmooth.estimators import baselines as baselines
from robsmooth.estimators.bound import minimize_bound as minimize_bound
from robsmooth.estimators.constant_minimax import ConstantMinimaxSmoother as ConstantMinimaxSmoother
from robsmooth.estimators.constant_minimax import (
    constant_minimax_smoother as constant_minimax_smoother,
)
from robsmooth.estimators.discrete import DiscreteSmoother as DiscreteSmoother
from robsmooth.estimators.estimator import Estimator as Estimator
from robsmooth.estimators.minimax import MinimaxSmoother as MinimaxSmoother
from robsmooth.estimators.minimax import minimax_smoother as minimax_smoother
from robsmooth.estimators.smoother import RobustSmoother as RobustSmoother
from robsmooth.estimators.smoother import design_smoother as design_smoother
from robsmooth.estimators.smoother import limiting_smoother as limiting_smoother
from robsmooth.homodyne.loop import statistical_linearisation as statistical_linearisation
from robsmooth.homodyne.moments import StationaryErrors as StationaryErrors
from robsmooth.homodyne.moments import stationary_errors as stationary_errors
from robsmooth.homodyne.montecarlo import LossOfLockWarning as LossOfLockWarning
from robsmooth.homodyne.montecarlo import MeanSquare as MeanSquare
from robsmooth.homodyne.montecarlo import MonteCarloResult as MonteCarloResult
from robsmooth.homodyne.montecarlo import monte_carlo as monte_carlo
from robsmooth.homodyne.study import Study as Study
from robsmooth.homodyne.study import parameter_study as parameter_study
from robsmooth.io.designs import load as load
from robsmooth.io.designs import save as save
from robsmooth.io.records import smooth_record as smooth_record
from robsmooth.paper.verdicts import verdicts as verdicts
from robsmooth.simulation.simulate import sample_paths as sample_paths
from robsmooth.simulation.simulate import simulate as simulate
from robsmooth.simulation.statistics import InadmissibleWarning as InadmissibleWarning
from robsmooth.simulation.statistics import SamplePaths as SamplePaths
from robsmooth.simulation.statistics import SimulationResult as SimulationResult
from robsmooth.systems import examples as examples
from robsmooth.systems.augmented import AugmentedSystem as AugmentedSystem
from robsmooth.systems.augmented import augment as augment
from robsmooth.systems.channels import Nonlinearity as Nonlinearity
from robsmooth.systems.channels import Uncertainty as Uncertainty
from robsmooth.systems.sector import Sector as Sector
from robsmooth.systems.sector import sector as sector
from robsmooth.systems.system import UncertainSystem as UncertainSystem

__version__: str
