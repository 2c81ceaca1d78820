"""The public names: each is imported when it is first asked for, and may be looked for by others.

`__init__.pyi` lists them, each with the module that defines it.
"""

import ast
import pkgutil
from importlib import import_module

_HOMES = {
    alias.name: node.module
    for node in ast.parse(pkgutil.get_data("robsmooth", "__init__.pyi")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
PUBLIC = sorted(_HOMES)

# What python-control, FilterPy, MATLAB and textbooks call it, in small letters and without
# underscores.
_OTHERS = {
    "augment": "pade",
    "baselines.fixed_lag_smoother": "",
    "baselines.kalman_bucy": "kalman kalmanfilter lqe",
    "baselines.ngcf": "",
    "baselines.optimal_fixed_lag_error": "",
    "baselines.optimal_two_sided_error": "",
    "baselines.tuned_fixed_lag_smoother": "",
    "baselines.worst_optimal_error": "",
    "error_covariance": "covariance",
    "homodyne.HomodyneParameters": "",
    "minimax_smoother": "robustfilter",
    "minimize_bound": "hinfsyn",
    "simulate": "lsim sim",
    "worst_case": "mussv wcgain",
    "AugmentedSystem.structured_delta": "",
    "Estimator.discretize": "c2d",
    "Estimator.to_statespace": "",
    "UncertainSystem": "uss",
    "UncertainSystem.from_plant": "ss",
    "UncertainSystem.from_statespace": "",
}


def _key(name: str) -> str:
    return name.lower().replace("_", "")


_ELSEWHERE = {other: here for here, others in _OTHERS.items() for other in others.split()}
_ELSEWHERE |= {_key(here.partition(".")[2]): here for here in _OTHERS if "." in here}


def find(name: str) -> object:
    """A public name's object, imported if need be; an AttributeError says what is nearest."""
    if name in _HOMES:
        home = import_module(_HOMES[name])
        # what its home does not hold is a module of it
        return vars(home).get(name) or import_module(f"{_HOMES[name]}.{name}")
    if name == "__version__":
        return _version()
    raise AttributeError(f"module 'robsmooth' has no attribute {name!r}{_hint(name)}")


def _hint(name: str) -> str:
    import difflib

    key, spelled = _key(name), {_key(public): public for public in PUBLIC}
    if name.startswith("_"):
        return ""
    if key in _ELSEWHERE:
        return f"; here it is robsmooth.{_ELSEWHERE[key]}"
    near = difflib.get_close_matches(key, [*spelled, *_ELSEWHERE], n=1)
    return f"; did you mean robsmooth.{(spelled | _ELSEWHERE)[near[0]]}?" if near else ""


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version("robsmooth")
    except metadata.PackageNotFoundError:  # sources that are imported where they lie
        return "0+unknown"
