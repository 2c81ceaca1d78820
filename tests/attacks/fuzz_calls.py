"""Random calls of everything public: ``python -m tests.attacks.fuzz_calls --tries N``.

A typical call has some arguments replaced by what does not belong there. It may work, or raise an
error that the package words itself, in one sentence. It changes no argument; the values that it
returns are read-only and share no memory with an argument; it answers an interrupt.
"""

import copy
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
from typing import Any, NamedTuple

import numpy as np
from matplotlib import pyplot

import robsmooth as rs
from robsmooth import baselines, examples, homodyne
from tests.helpers import trials
from tests.project.test_copies import VALUES, example

TRIES = 10_000
PATIENCE = 1.0  # s, then a call is interrupted
ANSWER = float(os.environ.get("ATTACK_ANSWER", "2"))  # s, until it has answered
PAPER = homodyne.PAPER
GAINS = ("A_c", "B_c", "C_c", "C_a", "C_f")
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
    def deltas() -> Any:
        return rs.delta_sweep(T.kalman(), [-1.0, 0.0, 1.0], "filtered")


T = Things
FOLDER = tempfile.mkdtemp(prefix="fuzz-")


def file(name: str) -> str:
    return str(Path(FOLDER) / name)


def record(rows: int = 30) -> Any:
    return np.random.default_rng(0).standard_normal((rows, 1))


class Call(NamedTuple):
    """A function and its typical arguments."""

    function: Callable
    typical: dict[str, Any]

    def arguments(self) -> dict[str, Any]:
        """Return typical arguments, made anew where they can be changed."""
        return {name: fresh(value) for name, value in self.typical.items()}


def fresh(value: Any) -> Any:
    if isinstance(value, partial):
        return value()
    return copy.deepcopy(value) if isinstance(value, list | dict | np.ndarray) else value


def call(function: Callable, /, **typical: Any) -> Call:
    return Call(function, typical)


def functions() -> dict[str, Call]:
    """Return every public function with typical arguments, by name."""
    loop = {"oscillator": "filtered", "copy": True, "shot_noise": 1.0}
    many = {"runs": 8, "seed": 0, "client": None, "checkpoint": None, "progress": False}
    paths = {"smoother": T.kalman(), "uncertainties": [0.0], "duration": 1e-4, "step": None}
    axes = {"lags": [1e-6], "orders": [2], "gammas": [0.4], "noises": [1.0]}
    delayed = {"system": T.system(), "delay": 3.1e-6, "order": 2}
    judged = {"smoother": T.robust(), "output": "filtered", "loop": "real"}
    given = {"plant": T.plant(), "tau": 1.1e-6, "multipliers": [1.0, 0.49, 1e-4, 1e-4]}
    designed = {"plant": T.plant(), "output": "smoothed"}
    homodyned = {"parameters": PAPER, "smoother": T.kalman(), **loop}
    smoother = {"smoother": partial(T.exact), "reference": None}
    recorded = {**smoother, "time": None, "columns": None, "regular": True, "output": "smoothed"}
    recorded |= {"chunk": 7, "header": None, "skip_rows": 0, "progress": False, "resume": False}
    dialect = {"delimiter": ",", "decimal": ".", "header": False, "missing": "nan", "time": 0}
    channel = {"B": [[1.0]], "C": [[0.1]], "D": [[0.0]]}
    square = {"A": [[-1.0]], "B1": [[1.0, 0.0]], "C0": [[1.0]], "C2": [[1.0]], "D21": [[0.0, 0.1]]}
    square |= {"uncertainties": [], "nonlinearities": [], "B2": np.eye(1), "D22": [[0.0]]}
    noises = {"process_noise": 1.0, "measurement_noise": 0.01, "gain_uncertainty": 0.1}
    own = {"lipschitz": 1.0, "function": np.tanh, "reference": "filtered", "sector": None}
    search = {"against": "constant", "progress": False}
    with_delta = {"Delta": T.plant().structured_delta(), "reference": None, "copy_noise": None}
    mirror = {"frequency": 1e3, "damping": 0.05, "rms": 0.25, "noise": 1e-3, "uncertainty": 0.02}
    made = {name: np.array(getattr(T.robust(), name)) for name in GAINS}
    from_plant = rs.UncertainSystem.from_plant
    return {
        "UncertainSystem": call(rs.UncertainSystem, **square),
        "from_plant": call(from_plant, plant=T.linear().to_statespace(), **noises),
        "Uncertainty": call(rs.Uncertainty, **channel),
        "Nonlinearity": call(rs.Nonlinearity, **channel, **own),
        "sector": call(rs.sector, function=np.tanh, reach=0.6),
        "augment": call(rs.augment, **delayed, J_21=1.0),
        "design_smoother": call(rs.design_smoother, **given, cost="filtered"),
        "limiting_smoother": call(rs.limiting_smoother, **given, cost="smoothed"),
        "minimize_bound": call(rs.minimize_bound, plant=T.plant(), cost="smoothed", starts=1),
        "minimax_smoother": call(rs.minimax_smoother, **designed),
        "constant_minimax_smoother": call(rs.constant_minimax_smoother, **designed),
        "best_smoother": call(rs.best_smoother, **designed, **search),
        "judge": call(rs.judge, estimator=T.kalman(), output="filtered"),
        "Estimator": call(rs.Estimator, plant=T.plant(), **made),
        "error_covariance": call(rs.error_covariance, **judged, **with_delta),
        "delta_sweep": call(rs.delta_sweep, **judged, nonlinearities=[-1.0, 0.0]),
        "worst_case": call(rs.worst_case, **judged),
        "analysis_bound": call(rs.analysis_bound, **judged, copy_noise=None),
        "lag_sweep": call(rs.lag_sweep, system=T.system(), lags=[1e-6], orders=[1], design=None),
        "best_lag": call(rs.best_lag, system=T.system(), order=1),
        "choose_lag": call(rs.choose_lag, system=T.system(), target=None, fraction=0.5),
        "check_record": call(rs.check_record, **smoother, y=record(), inputs=None),
        "smooth_record": call(rs.smooth_record, **recorded, source=record(), target=None),
        "a file's smooth_record": call(
            rs.smooth_record,
            **recorded | dialect | {"source": written(), "target": file("w.csv"), "columns": 1},
        ),
        "save": call(rs.save, value=T.system(), path=file("system.toml")),
        "load": call(rs.load, path=saved(), functions=None),
        "simulate": call(rs.simulate, **paths, **many),
        "sample_paths": call(rs.sample_paths, **paths, runs=2, seed=0),
        "monte_carlo": call(rs.monte_carlo, **homodyned, **many, protocol="ergodic", step=None),
        "parameter_study": call(rs.parameter_study, parameters=PAPER, **axes, **many),
        "stationary_errors": call(rs.stationary_errors, **homodyned),
        "statistical_linearisation": call(rs.statistical_linearisation, **homodyned),
        "verdicts": call(rs.verdicts, data_dir=None, kinds=["input"]),
        "HomodyneParameters": call(homodyne.HomodyneParameters, **vars(PAPER)),
        "random_walk": call(examples.random_walk, diffusion=1.0, noise=1.0),
        "clock": call(examples.clock, phase_noise=1.0, frequency_noise=0.1, noise=1.0),
        "resonant_phase": call(examples.resonant_phase, **mirror),
        "kalman_bucy": call(baselines.kalman_bucy, system=T.system(), copies=False),
        "fixed_lag_smoother": call(baselines.fixed_lag_smoother, **delayed, copies=True),
        "ngcf": call(baselines.ngcf, system=T.system()),
        "optimal_fixed_lag_error": call(
            baselines.optimal_fixed_lag_error, system=T.system(), delay=1e-6
        ),
        "optimal_two_sided_error": call(baselines.optimal_two_sided_error, system=T.system()),
        "worst_optimal_error": call(baselines.worst_optimal_error, system=T.system(), delay=1e-6),
        "tuned_fixed_lag_smoother": call(
            baselines.tuned_fixed_lag_smoother, **designed, against="constant"
        ),
    }


def classes() -> dict[str, Call]:
    """Return the public classes of results, with the fields of an example, by name."""
    found = {}
    for name in VALUES:
        if name not in ("UncertainSystem", "Uncertainty", "Nonlinearity", "Estimator"):
            value = example(name)
            fields = {each.name: each for each in dataclasses.fields(value) if each.init}
            found[name] = Call(type(value), {each: getattr(value, each) for each in fields})
    return found


def methods() -> dict[str, Call]:
    """Return the methods of what the functions return, with typical arguments, by name."""
    made = {"dt": 1e-6, "delay": None, "mean": None, "offset": None, "samples": "means"}
    channel = {"B": [[0.0]], "C": [[1.0]], "D": [[1.0]], "noise": 0.1}
    both = {"uncertainties": [0.5], "nonlinearities": [0.5]}
    own = {
        "to_statespace of a system": call(T.system().to_statespace),
        "structured_delta": call(T.plant().structured_delta, **both),
        "M": call(T.plant().M, multipliers=list(MULTIPLIERS)),
        "response": call(T.plant().delay_model.response, omega=[1.0, 2.0]),
        "to_statespace": call(T.robust().to_statespace, slopes=[0.0]),
        "discretize": call(T.kalman().discretize, **made, functions=None),
        "discretize with a model": call(
            T.robust().discretize, **made | {"delay": "model"}, functions=[np.sin]
        ),
        "nonlinearity": call(T.sector().nonlinearity, **channel),
        "remainder": call(PAPER.remainder, error=[0.1, 0.2]),
        "sector_range": call(PAPER.sector_range, slope=0.5),
        "with_gain": call(PAPER.with_gain, gain=0.9),
        "to_dict": call(example("MonteCarloResult").to_dict),
    }
    for name in VALUES:
        value = example(name)
        for method, typical in (("plot", {"ax": None}), ("to_frame", {})):
            if hasattr(type(value), method):
                own[f"{method} of {name}"] = Call(getattr(value, method), typical)
    own["plot of LagSweep"].typical["error"] = "nominal"
    own["plot of DeltaSweep"] = call(T.deltas().plot, ax=None, label=None)
    own["plot of Study"].typical.update(gamma=None, noise=None)
    y = {"reference": None, "intervals": None, "inputs": None}
    for name in ("exact", "driven", "model"):
        one = y | {"inputs": np.zeros((30, 1)) if name == "driven" else None}
        row = {"y": [0.1], "reference": None, "interval": None}
        row["inputs"] = [0.0] if name == "driven" else None
        of = partial(method_of, name)
        own |= {
            f"run, {name}": call(of("run"), **one, y=record(), output="smoothed", return_std=False),
            f"step, {name}": call(of("step"), **row),
            f"reset, {name}": call(of("reset"), state=None, samples=0, covariance=None),
            f"times, {name}": call(of("times"), rows=0, output="filtered"),
        }
    for method in ("two_sided", "innovations"):
        own[method] = call(method_of("exact", method), **y, y=record())
    text = {"functions": ["sin(x)"], "precision": "double"}
    own["to_c"] = call(method_of("model", "to_c"), path=file("m.c"), **text)
    return own


def method_of(name: str, method: str) -> Callable:
    """Return a method of a smoother of records, which is made for the call."""
    return lambda **of: getattr(getattr(T, name)(), method)(**of)


@cache
def calls() -> dict[str, Call]:
    return classes() | functions() | methods()


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
        "\udcff", list[int],
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
    lambda: np.broadcast_to(0.0, (2000, 2000)), lambda: np.frombuffer(b"x" * 8)[:1],
    lambda: np.ones(3).flat, lambda: [list[int]], lambda: [lambda: 0.0], lambda: [lambda t, x: x],
    T.system, T.linear, T.plant, T.robust, T.kalman, T.sector, T.exact, T.model,
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
        ways += [lambda: np.float32(value), lambda: Decimal(value), lambda: np.array([value])]
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
    arguments = calls()[name].arguments()
    for each in rng.sample(list(arguments), min(len(arguments), rng.choice([1, 1, 1, 2, 3]))):
        near = rng.random() < 0.4
        arguments[each] = changed(rng, arguments[each]) if near else rng.choice(JUNK)()
    return name, calls()[name].function, arguments


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
    odd = {name: each for name, each in arguments.items() if each is not typical[name]}
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
        with warnings.catch_warnings(action="ignore"):
            for each in calls().values():
                each.function(**each.arguments())
        return "ready", None
    name, function, arguments = case(seed, number)
    pyplot.close("all")
    before = state_of(arguments)
    what = f"{name}({shown(arguments, calls()[name].typical)})"
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
