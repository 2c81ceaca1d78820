"""The public names: where each is defined, and what else they may be looked for by.

`import robsmooth` imports none of them; each is imported when it is first asked for. The package's
face has the same names once more, for type checkers.
"""

from importlib import import_module

# Names by the module that defines them; a module that is itself public stands alone.
_HOMES = {
    "robsmooth._support.errors": ("InfeasibleDesignError", "UnstableLoopError"),
    "robsmooth._numerics.steps": ("LongStepWarning",),
    "robsmooth.analysis.constraints": ("AnalysisBound", "analysis_bound"),
    "robsmooth.analysis.covariance": (
        "delta_sweep",
        "error_covariance",
    ),
    "robsmooth.analysis.lag": ("LagChoice", "LagSweep", "best_lag", "choose_lag", "lag_sweep"),
    "robsmooth.analysis.statistical_linearisation": ("statistical_linearisation",),
    "robsmooth.analysis.worst_case": (
        "WorstCase",
        "WorstDynamicCase",
        "worst_case",
        "worst_dynamic_case",
    ),
    "robsmooth.estimators.baselines": (),
    "robsmooth.estimators.bound": ("minimize_bound",),
    "robsmooth.estimators.discrete": ("DiscreteSmoother",),
    "robsmooth.estimators.estimator": ("Estimator",),
    "robsmooth.estimators.limit": ("limiting_smoother",),
    "robsmooth.estimators.smoother": ("RobustSmoother", "design_smoother"),
    "robsmooth.homodyne": (),
    "robsmooth.homodyne.moments": ("StationaryErrors", "stationary_errors"),
    "robsmooth.homodyne.montecarlo": (
        "LossOfLockWarning",
        "MeanSquare",
        "MonteCarloResult",
        "monte_carlo",
    ),
    "robsmooth.homodyne.study": ("Study", "parameter_study"),
    "robsmooth.io.designs": ("load", "save"),
    "robsmooth.io.records": ("smooth_record",),
    "robsmooth.paper.verdicts": ("verdicts",),
    "robsmooth.simulation.statistics": (
        "InadmissibleWarning",
        "SamplePaths",
        "SimulatedError",
        "SimulationResult",
    ),
    "robsmooth.simulation.simulate": ("sample_paths", "simulate"),
    "robsmooth.systems.augmented": ("AugmentedSystem", "augment"),
    "robsmooth.systems.channels": ("Nonlinearity", "Uncertainty"),
    "robsmooth.systems.system": ("UncertainSystem",),
}
# From a name to its module, and whether it is the module.
_PLACES = {
    name or module.rpartition(".")[2]: (module, name)
    for module, names in _HOMES.items()
    for name in names or ("",)
}
PUBLIC = sorted(_PLACES)

# What python-control, FilterPy, MATLAB, textbooks and the rest of this package call it, in small
# letters and without underscores.
_ELSEWHERE = {
    "kalman": "baselines.kalman_bucy",
    "kalmanbucy": "baselines.kalman_bucy",
    "kalmanfilter": "baselines.kalman_bucy",
    "lqe": "baselines.kalman_bucy",
    "fixedlagsmoother": "baselines.fixed_lag_smoother",
    "linearrobustfilter": "baselines.linear_robust_filter",
    "robustfilter": "baselines.linear_robust_filter",
    "ngcf": "baselines.ngcf",
    "optimalfixedlagerror": "baselines.optimal_fixed_lag_error",
    "optimaltwosidederror": "baselines.optimal_two_sided_error",
    "homodyneparameters": "homodyne.HomodyneParameters",
    "hinfsyn": "minimize_bound",
    "pade": "augment",
    "ss": "UncertainSystem.from_plant",
    "uss": "UncertainSystem",
    "fromplant": "UncertainSystem.from_plant",
    "fromstatespace": "UncertainSystem.from_statespace",
    "c2d": "Estimator.discretize",
    "discretize": "Estimator.discretize",
    "tostatespace": "Estimator.to_statespace",
    "structureddelta": "AugmentedSystem.structured_delta",
    "covariance": "error_covariance",
    "lsim": "simulate",
    "sim": "simulate",
    "mussv": "worst_case",
    "wcgain": "worst_case",
}


def find(name: str) -> object:
    """Return a public name's object, imported if need be.

    Raises
    ------
    AttributeError
        For another name; it says what is nearest to it.
    """
    if name in _PLACES:
        module, attribute = _PLACES[name]
        found = import_module(module)
        return getattr(found, attribute) if attribute else found
    if name == "__version__":
        return _version()
    raise AttributeError(f"module 'robsmooth' has no attribute {name!r}{_hint(name)}")


def _hint(name: str) -> str:
    import difflib

    if name.startswith("_"):
        return ""
    key = name.lower().replace("_", "")
    if key in _ELSEWHERE:
        return f"; here it is robsmooth.{_ELSEWHERE[key]}"
    spelled = {public.lower().replace("_", ""): public for public in PUBLIC}
    near = difflib.get_close_matches(key, [*spelled, *_ELSEWHERE], n=1)
    return f"; did you mean robsmooth.{(spelled | _ELSEWHERE)[near[0]]}?" if near else ""


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version("robsmooth")
    except metadata.PackageNotFoundError:  # sources that are imported where they lie
        return "0+unknown"
