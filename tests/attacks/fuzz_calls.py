"""Random calls of everything public: ``python -m tests.attacks.fuzz_calls --tries N``.

A typical call has some arguments replaced by what does not belong there. It may work, or raise an
error that the package words itself, in one sentence. It changes no argument; the values that it
returns are read-only and share no memory with an argument; it answers an interrupt.
"""

import dataclasses
import itertools
import os
import random
import signal
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from decimal import Decimal
from fractions import Fraction
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot

import robsmooth as rs
from robsmooth import baselines, examples, homodyne
from tests.helpers import trials

TRIES = 10_000
PATIENCE = 1.0  # s, then a call is interrupted
ANSWER = float(os.environ.get("ATTACK_ANSWER", "2"))  # s, until it has answered
PAPER = homodyne.PAPER
MULTIPLIERS = [1.0, 0.4999, 1e-6, 1e-6]


class Things:
    """What calls are made with, each made once."""

    @staticmethod
    @cache
    def system() -> Any:
        return PAPER.uncertain_system()

    @staticmethod
    @cache
    def linear() -> Any:
        gain = rs.Uncertainty([[0.0], [0.0]], [[0.05, 0.0]], [[1.0]])
        A, B1 = [[-1.0, 0.5], [0.0, -2.0]], [[1.0, 0.0], [0.5, 0.0]]
        C = [[1.0, 0.0]]
        return rs.UncertainSystem(A, B1, C, C, [[0.0, 0.1]], [gain], B2=[[1.0], [0.0]])

    @staticmethod
    @cache
    def plant() -> Any:
        return rs.augment(T.system(), 3.1e-6, 2)

    @staticmethod
    @cache
    def robust() -> Any:
        return rs.design_smoother(T.plant(), 1.0987e-6, MULTIPLIERS)

    @staticmethod
    @cache
    def kalman() -> Any:
        return baselines.kalman_bucy(T.system())

    @staticmethod
    @cache
    def sector() -> Any:
        return rs.sector(np.tanh, 0.6)

    @staticmethod
    def exact() -> Any:
        return baselines.fixed_lag_smoother(T.system(), 3.1e-6, 2).discretize(1e-6)

    @staticmethod
    def driven() -> Any:
        return baselines.kalman_bucy(T.linear()).discretize(0.01)

    @staticmethod
    def model() -> Any:
        return T.robust().discretize(1e-6, delay="model")

    @staticmethod
    @cache
    def sweep() -> Any:
        return rs.lag_sweep(T.system(), [1e-6, 2e-6], [1])

    @staticmethod
    @cache
    def deltas() -> Any:
        return rs.delta_sweep(T.kalman(), [-1.0, 0.0, 1.0], "filtered")

    @staticmethod
    @cache
    def study() -> Any:
        return rs.Study((0.4,), (1.0,), (2,), (1e-6, 3e-6), {"bound": [[[[0.1, 0.1]]]]}, {})

    @staticmethod
    @cache
    def choice() -> Any:
        judged = rs.judge(T.kalman())
        from robsmooth.analysis.choice import Candidate

        candidates = {"classical": Candidate(T.kalman(), judged)}
        return rs.Choice(T.kalman(), "classical", candidates, "constant", "smoothed")

    @staticmethod
    @cache
    def measured() -> Any:
        return rs.monte_carlo(PAPER, T.kalman(), runs=64)


T = Things
FOLDER = tempfile.mkdtemp(prefix="fuzz-")


def file(name: str) -> str:
    return str(Path(FOLDER) / name)


def matrices(estimator: Any) -> dict[str, Any]:
    return {
        name: np.array(getattr(estimator, name)) for name in ("A_c", "B_c", "C_c", "C_a", "C_f")
    }


def record(rows: int = 30) -> Any:
    return np.random.default_rng(0).standard_normal((rows, 1))


def fields(value: Any) -> dict[str, Any]:
    return {each.name: getattr(value, each.name) for each in dataclasses.fields(value) if each.init}


Call = tuple[Callable, Callable[[], dict[str, Any]]]


def functions() -> dict[str, Call]:
    """Return every public function and class with typical arguments, by name."""
    loop = {"oscillator": "filtered", "copy": True, "shot_noise": 1.0}
    runs = {"runs": 8, "duration": 1e-4, "step": None, "seed": 0, "checkpoint": None}
    lists = {"lags": [1e-6], "orders": [2], "gammas": [0.4], "noises": [1.0]}
    square = {"A": [[-1.0]], "B1": [[1.0, 0.0]], "C0": [[1.0]], "C2": [[1.0]], "D21": [[0.0, 0.1]]}
    channel = {"B": [[1.0]], "C": [[0.1]], "D": [[0.0]]}
    delayed = {"system": T.system(), "delay": 3.1e-6, "order": 2}
    judged = {"smoother": T.robust(), "output": "filtered", "loop": "real"}
    designed = {"plant": T.plant(), "tau": 1.1e-6, "multipliers": [1.0, 0.49, 1e-4, 1e-4]}
    return {
        "UncertainSystem": (rs.UncertainSystem, lambda: square | {"uncertainties": [], "nonlinearities": [], "B2": np.eye(1), "D22": [[0.0]]}),
        "UncertainSystem.from_plant": (rs.UncertainSystem.from_plant, lambda: {"plant": T.linear().to_statespace(), "process_noise": 1.0, "measurement_noise": 0.01, "gain_uncertainty": 0.1}),
        "Uncertainty": (rs.Uncertainty, lambda: dict(channel)),
        "Nonlinearity": (rs.Nonlinearity, lambda: channel | {"lipschitz": 1.0, "function": np.tanh, "reference": "filtered", "sector": None}),
        "sector": (rs.sector, lambda: {"function": np.tanh, "reach": 0.6}),
        "augment": (rs.augment, lambda: delayed | {"J_21": 1.0}),
        "design_smoother": (rs.design_smoother, lambda: designed | {"cost": "filtered"}),
        "limiting_smoother": (rs.limiting_smoother, lambda: designed | {"cost": "smoothed"}),
        "minimize_bound": (rs.minimize_bound, lambda: {"plant": T.plant(), "cost": "smoothed", "starts": 1}),
        "minimax_smoother": (rs.minimax_smoother, lambda: {"plant": T.plant(), "output": "smoothed"}),
        "constant_minimax_smoother": (rs.constant_minimax_smoother, lambda: {"plant": T.plant(), "output": "smoothed"}),
        "best_smoother": (rs.best_smoother, lambda: {"plant": T.plant(), "against": "constant", "output": "smoothed", "progress": False}),
        "judge": (rs.judge, lambda: {"estimator": T.kalman(), "output": "filtered"}),
        "Estimator": (rs.Estimator, lambda: {"plant": T.plant(), **matrices(T.robust())}),
        "RobustSmoother": (rs.RobustSmoother, lambda: fields(T.robust())),
        "error_covariance": (rs.error_covariance, lambda: judged | {"Delta": T.plant().structured_delta(), "allow_inadmissible": False, "reference": None, "copy_noise": None}),
        "delta_sweep": (rs.delta_sweep, lambda: judged | {"nonlinearities": [-1.0, 0.0]}),
        "worst_case": (rs.worst_case, lambda: dict(judged)),
        "analysis_bound": (rs.analysis_bound, lambda: judged | {"copy_noise": None}),
        "lag_sweep": (rs.lag_sweep, lambda: {"system": T.system(), "lags": [1e-6], "orders": [1], "design": None, "progress": False}),
        "best_lag": (rs.best_lag, lambda: {"system": T.system(), "order": 1}),
        "choose_lag": (rs.choose_lag, lambda: {"system": T.system(), "target": None, "fraction": 0.5}),
        "check_record": (rs.check_record, lambda: {"smoother": T.exact(), "y": record(), "reference": None, "inputs": None}),
        "smooth_record": (rs.smooth_record, lambda: {"smoother": T.exact(), "source": record(), "target": None, "columns": None, "reference": None, "time": None, "regular": True, "output": "smoothed", "chunk": 7, "delimiter": None, "header": None, "skip_rows": 0}),
        "smooth_record of a file": (rs.smooth_record, lambda: {"smoother": T.exact(), "source": written(), "target": file("w.csv"), "columns": 1, "reference": None, "time": 0, "regular": True, "output": "smoothed", "chunk": 7, "delimiter": ",", "decimal": ".", "header": False, "skip_rows": 0, "missing": "nan", "resume": False}),
        "save": (rs.save, lambda: {"value": T.system(), "path": file("system.toml")}),
        "load": (rs.load, lambda: {"path": saved(), "functions": None}),
        "simulate": (rs.simulate, lambda: {"smoother": T.kalman(), "uncertainties": [0.0], **runs}),
        "sample_paths": (rs.sample_paths, lambda: {"smoother": T.kalman(), "uncertainties": [0.0], "runs": 2, "duration": 1e-4, "step": None, "seed": 0}),
        "monte_carlo": (rs.monte_carlo, lambda: {"parameters": PAPER, "smoother": T.kalman(), "protocol": "ergodic", "precision": "mixed", **runs, **loop}),
        "parameter_study": (rs.parameter_study, lambda: {"parameters": PAPER, **lists, "runs": 8, "seed": 0, "checkpoint": None}),
        "stationary_errors": (rs.stationary_errors, lambda: {"parameters": PAPER, "smoother": T.kalman(), **loop}),
        "statistical_linearisation": (rs.statistical_linearisation, lambda: {"parameters": PAPER, "smoother": T.kalman(), **loop}),
        "verdicts": (rs.verdicts, lambda: {"data_dir": None, "kinds": ["input"]}),
        "HomodyneParameters": (homodyne.HomodyneParameters, lambda: dict(vars(PAPER))),
        "fraction_inside": (homodyne.fraction_inside, lambda: {"error_range": 1.0, "variance": 0.25}),
        "random_walk": (examples.random_walk, lambda: {"diffusion": 1.0, "noise": 1.0}),
        "clock": (examples.clock, lambda: {"phase_noise": 1.0, "frequency_noise": 0.1, "noise": 1.0}),
        "resonant_phase": (examples.resonant_phase, lambda: {"frequency": 1e3, "damping": 0.05, "rms": 0.25, "noise": 1e-3, "uncertainty": 0.02}),
        "kalman_bucy": (baselines.kalman_bucy, lambda: {"system": T.system(), "copies": False}),
        "fixed_lag_smoother": (baselines.fixed_lag_smoother, lambda: delayed | {"copies": True}),
        "ngcf": (baselines.ngcf, lambda: {"system": T.system()}),
        "optimal_fixed_lag_error": (baselines.optimal_fixed_lag_error, lambda: {"system": T.system(), "delay": 1e-6}),
        "optimal_two_sided_error": (baselines.optimal_two_sided_error, lambda: {"system": T.system()}),
        "worst_optimal_error": (baselines.worst_optimal_error, lambda: {"system": T.system(), "delay": 1e-6}),
        "tuned_fixed_lag_smoother": (baselines.tuned_fixed_lag_smoother, lambda: {"plant": T.plant(), "against": "constant", "output": "smoothed"}),
        "Study": (rs.Study, lambda: fields(T.study())),
        "LagSweep": (rs.LagSweep, lambda: fields(T.sweep())),
        "MeanSquare": (rs.MeanSquare, lambda: {"mean_square": 0.1, "standard_error": 0.01}),
    }  # fmt: skip


def methods() -> dict[str, Call]:
    """Return the methods of what the functions return, with typical arguments, by name."""
    y = {"y": record(), "reference": None, "inputs": None, "intervals": None}
    row = {"y": [0.1], "reference": None, "inputs": None, "interval": None}
    made = {
        "dt": 1e-6,
        "functions": None,
        "delay": None,
        "mean": None,
        "offset": None,
        "samples": "means",
    }
    inputs = np.zeros((30, 1))
    own = {
        "system.to_statespace": (T.system().to_statespace, dict),
        "plant.structured_delta": (T.plant().structured_delta, lambda: {"uncertainties": [0.5], "nonlinearities": [0.5]}),
        "plant.M": (T.plant().M, lambda: {"multipliers": list(MULTIPLIERS)}),
        "delay_model.response": (T.plant().delay_model.response, lambda: {"omega": [1.0, 2.0]}),
        "estimator.to_statespace": (T.robust().to_statespace, lambda: {"slopes": [0.0]}),
        "estimator.discretize": (T.kalman().discretize, lambda: dict(made)),
        "robust.discretize": (T.robust().discretize, lambda: made | {"functions": [np.sin], "delay": "model"}),
        "sector.nonlinearity": (T.sector().nonlinearity, lambda: {"B": [[0.0]], "C": [[1.0]], "D": [[1.0]], "noise": 0.1}),
        "parameters.remainder": (PAPER.remainder, lambda: {"error": [0.1, 0.2]}),
        "parameters.sector_range": (PAPER.sector_range, lambda: {"slope": 0.5}),
        "parameters.with_gain": (PAPER.with_gain, lambda: {"gain": 0.9}),
        "lag_sweep.plot": (T.sweep().plot, lambda: {"ax": None, "error": "nominal"}),
        "delta_sweep.plot": (T.deltas().plot, lambda: {"ax": None, "label": None}),
        "delta_sweep.to_frame": (T.deltas().to_frame, dict),
        "study.plot": (T.study().to_frame, dict),
        "choice.to_frame": (T.choice().to_frame, dict),
        "monte_carlo.to_dict": (T.measured().to_dict, dict),
    }  # fmt: skip
    for name in ("exact", "driven", "model"):
        kind = partial(lambda name, method, **of: getattr(getattr(T, name)(), method)(**of), name)
        more = {"inputs": inputs} if name == "driven" else {}
        one = {"inputs": [0.0]} if name == "driven" else {}
        own |= {
            f"{name}.run": (partial(kind, "run"), partial(dict, y | more, output="smoothed", return_std=False)),
            f"{name}.step": (partial(kind, "step"), partial(dict, row | one)),
            f"{name}.reset": (partial(kind, "reset"), partial(dict, state=None, samples=0, covariance=None)),
            f"{name}.times": (partial(kind, "times"), partial(dict, rows=0, output="filtered")),
        }  # fmt: skip
    for method in ("bank", "two_sided", "innovations"):
        lags = {"lags": [0, 1]} if method == "bank" else {}
        call = partial(lambda method, **of: getattr(T.exact(), method)(**of), method)
        own[f"exact.{method}"] = call, partial(dict, y | lags)
    to_c = partial(lambda **of: T.model().to_c(**of))
    own["model.to_c"] = (
        to_c,
        lambda: {"path": file("m.c"), "functions": ["sin(x)"], "precision": "double"},
    )
    return own


@cache
def calls() -> dict[str, Call]:
    return functions() | methods()


@cache
def written() -> str:
    times = 1e-6 * np.arange(30.0)
    np.savetxt(file("y.csv"), np.column_stack([times, record()]), "%.17g", ",")
    return file("y.csv")


@cache
def saved() -> str:
    rs.save(T.system(), file("saved.json"))
    return file("saved.json")


def nested(depth: int) -> list:
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


def endless() -> list:
    value: list = [1.0]
    value.append(value)
    return value


JUNK: list[Callable[[], Any]] = [
    *(partial(lambda value: value, value) for value in (
        None, True, False, 0, 1, -1, 2, 3, 0.0, -0.0, 0.5, -1.5, np.nan, np.inf, -np.inf, 5e-324,
        1e-300, 1e300, 10**400, -(10**400), 2**63, 2**64, 10**15, 10**6, 1j, Fraction(1, 2),
        Decimal("0.5"), "", "x", "smoothed", "1.0", "x" * 5000, "a\nb", "a\0b", "\ud800", b"ab", (),
        ..., NotImplemented, slice(3), range(3), range(10**6), int, float, len, dict, np, object(),
        np.float32(0.5), np.int8(3), np.uint64(2**63), np.longdouble("1e4000"), np.bool_(True),
        np.timedelta64(1, "us"), np.datetime64("2020-01-01"), np.str_("smoothed"), np.void(b"ab"),
        np.float16(0.5), np.complex64(1.0), Path("x"), Path(FOLDER), Path("x.toml"), "x.csv",
        frozenset([1.0]), "/dev/null", "no/such/folder/x.toml", PAPER, rs.MeanSquare(0.1, 0.1),
        np.sin, np.cos, np.add, str.upper, lambda: 1.0, lambda x: x, lambda *x: None,
    )),
    list, dict, set, object, lambda: {1.0}, lambda: {1.0, 2.0}, lambda: {"a": 1.0}, lambda: [1.0],
    lambda: [[]], lambda: [[[]]], lambda: [np.nan], lambda: [[True]], lambda: [None], lambda: ["x"],
    lambda: [[1.0], [2.0, 3.0]], lambda: [1.0, "x"], lambda: [10**400], lambda: [-1], lambda: [1j],
    lambda: {"smoothed"}, lambda: [object()], lambda: [[1.0], 2.0], lambda: [np.eye(2), np.eye(3)],
    partial(nested, 40), partial(nested, 5000), endless, lambda: bytearray(b"ab"),
    lambda: memoryview(b"abc"), lambda: iter([1.0]), lambda: iter([]), itertools.count,
    lambda: itertools.repeat(1.0), lambda: (x for x in [1.0, 2.0]), lambda: map(str, [1.0]),
    lambda: np.array([]), lambda: np.zeros((0, 0)), lambda: np.zeros((3, 0)), lambda: np.array(1.0),
    lambda: np.array("smoothed"), lambda: np.array(["smoothed"]), lambda: np.array(["a", "b"]),
    lambda: np.eye(2), lambda: np.ones((1, 1)), lambda: np.ones((2, 2, 2)), lambda: np.array([1j]),
    lambda: np.array([None]), lambda: np.array([{}, []], dtype=object), lambda: np.array([np.nan]),
    lambda: np.array([1e308]), lambda: np.ma.array([1.0], mask=[True]), lambda: np.ma.masked,
    lambda: np.ones(2, dtype=[("a", float)]), lambda: np.array([1, 2], "timedelta64[ns]"),
    lambda: np.array(["2020-01-01"], "datetime64[D]"), lambda: np.array([True]),
    lambda: np.array([[1.0]]).view(np.matrix), lambda: np.array(b"ab"), lambda: np.array(5),
    lambda: np.array([1.0], ">f8"), lambda: np.array([2], np.uint8), lambda: np.ones((1,) * 30),
    lambda: np.broadcast_to(0.0, (10**6, 10**6)), lambda: np.frombuffer(b"x" * 8)[:1],
    T.system, T.linear, T.plant, T.robust, T.kalman, T.sector, T.exact, T.model, T.sweep, T.study,
]  # fmt: skip


def changed(rng: random.Random, value: Any) -> Any:
    """Return a value near a typical one."""
    ways: list[Callable[[], Any]] = [
        lambda: [value],
        lambda: {"value": value},
        lambda: (value,) * 2,
    ]
    if isinstance(value, str):
        ways += [value.upper, value.encode, lambda: np.array(value), lambda: value + " "]
        ways += [lambda: np.array([value]), lambda: np.str_(value), lambda: Path(value)]
    if isinstance(value, int | float) and not isinstance(value, bool):
        factor = rng.choice([0, -1, 0.5, 2, 1e3, 1e-3, 1e9, 1e-9, 1e200, 1e-200])
        ways += [lambda: value * factor, lambda: np.array(value), lambda: str(value)]
        ways += [lambda: np.float32(value), lambda: Fraction(value), lambda: np.array([value])]
    if isinstance(value, list | np.ndarray):
        array = np.array(value, dtype=object if callable(next(iter(value), 0)) else None)
        ways += [lambda: iter(value), lambda: dict.fromkeys(map(str, value)), lambda: array.T]
        ways += [array.tolist, lambda: array[:-1], lambda: np.concatenate([array, array])]
        ways += [lambda: array.astype(object), lambda: array[..., None], lambda: list(array)]
        ways += [lambda: set(array.ravel().tolist()), lambda: tuple(value)]
        if array.dtype.kind in "if" and array.size:
            odd = rng.choice([np.nan, np.inf, 1e308, -1e308, 1e-320, -1.0, 0.0, 1e30, 1e-30])
            at, mixed = rng.randrange(array.size), array.astype(object)
            one = array.astype(float)
            one.flat[at] = odd
            mixed.flat[at] = rng.choice(["x", None, True, 1j, 10**400, np.timedelta64(1), [1.0]])
            ways += [lambda: one, one.tolist, mixed.tolist, lambda: mixed]
            ways += [lambda: odd * array, lambda: array + 0j, lambda: array > 0]
            ways += [lambda: array.astype("f4"), lambda: np.asfortranarray(array)]
            ways += [lambda: np.ma.masked_less(array, 0.1), lambda: array.astype(str)]
    return rng.choice(ways)()


def case(seed: int, number: int) -> tuple[str, Callable, dict[str, Any]]:
    """Return a call: its name, the function and the arguments."""
    rng = random.Random(f"{seed}, {number}")
    name = rng.choice(list(calls()))
    function, typical = calls()[name]
    arguments = dict(typical())
    for each in rng.sample(list(arguments), min(len(arguments), rng.choice([1, 1, 1, 2, 3]))):
        near = rng.random() < 0.4
        arguments[each] = changed(rng, arguments[each]) if near else rng.choice(JUNK)()
    return name, function, arguments


def state_of(value: Any, depth: int = 0) -> Any:
    """Return what must stay as it was of an argument."""
    if value is np.ma.masked:
        return None
    if isinstance(value, np.ndarray):
        kept = value.tobytes() if value.nbytes < 10**6 and value.dtype != object else None
        return value.shape, value.dtype.str, value.strides, value.flags.writeable, kept
    if depth < 10 and isinstance(value, list | tuple):
        return [state_of(each, depth + 1) for each in value]
    if depth < 10 and isinstance(value, dict):
        return {key: state_of(each, depth + 1) for key, each in value.items()}
    return repr(value) if isinstance(value, set | bytearray) else id(value)


def parts(value: Any, depth: int = 0) -> Iterator[Any]:
    """Yield a value and all that it holds."""
    yield value
    if depth > 8:
        return
    inner: Any = ()
    if isinstance(value, Mapping):
        inner = value.values()
    elif isinstance(value, list | tuple):
        inner = value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        inner = vars(value).values()
    for part in inner:
        yield from parts(part, depth + 1)


def fault_in(result: Any, arguments: dict[str, Any]) -> str | None:
    """Return what is wrong with a result: arrays that can be written, or that are the caller's."""
    given = [each for each in parts(arguments) if isinstance(each, np.ndarray)]
    given = [each for each in given if each.flags.writeable and each.size]
    for part in parts(result):
        if isinstance(part, np.ndarray) and any(np.may_share_memory(part, own) for own in given):
            return f"an array {part.shape} of the result is the caller's"
    if not type(result).__module__.startswith("robsmooth"):
        return None
    for part in parts(result):
        if isinstance(part, np.ndarray):
            try:
                part.flags.writeable = True
            except ValueError:
                continue
            return f"an array {part.shape} of {type(result).__name__} can be written"
        if isinstance(part, dict):
            try:
                part["written"] = part.pop("written", None)
            except TypeError:
                continue
            return f"a dict of {type(result).__name__} can be written"
    return None


def shown(arguments: dict[str, Any], typical: dict[str, Any]) -> str:
    """Return the arguments that are not the typical ones."""
    odd = {name: each for name, each in arguments.items() if each is not typical.get(name)}
    texts = []
    for name, each in odd.items():
        try:
            texts.append(f"{name}={' '.join(repr(each).split())[:80]}")
        except Exception:
            texts.append(f"{name}=a {type(each).__name__}")
    return ", ".join(texts)


def trial(seed: int, number: int) -> tuple[str, str | None]:
    """Make a call; return the outcome, and the failure if there is one."""
    if number < 0:
        for function, typical in calls().values():
            with warnings.catch_warnings(action="ignore"):
                function(**typical())
        return "ready", None
    name, function, arguments = case(seed, number)
    pyplot.close("all")
    before = state_of(arguments)
    what = f"{name}({shown(arguments, calls()[name][1]())})"
    outcome, fault = attempt(partial(function, **arguments), arguments)
    if fault is None and state_of(arguments) != before:
        fault = "an argument was changed"
    return outcome, None if fault is None else f"{what}: {fault}"


def attempt(call: Callable[[], Any], arguments: dict[str, Any]) -> tuple[str, str | None]:
    """Return the outcome of a call, which is interrupted after a time, and what is wrong."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before, started = signal.signal(signal.SIGALRM, interrupt), time.perf_counter()
    try:
        try:
            signal.setitimer(signal.ITIMER_REAL, PATIENCE)
            with warnings.catch_warnings(action="ignore"):
                result = call()
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    except KeyboardInterrupt:
        return "interrupted", late(started)
    except OSError as error:  # of a path
        return "refused", None if error.filename is not None else trials.fault_of(error)
    except Exception as error:
        return "refused", trials.fault_of(error) or late(started)
    finally:
        signal.signal(signal.SIGALRM, before)
    return "accepted", fault_in(result, arguments) or late(started)


def late(started: float) -> str | None:
    """Return that a call did not answer an interrupt, if so."""
    past = time.perf_counter() - started - PATIENCE
    return f"no answer to an interrupt for {past:.1f} s" if past > ANSWER else None


if __name__ == "__main__":
    trials.main("random calls", trial, TRIES)
