"""Run the notebooks that are not fresh, and publish what those that succeed have written.

Notebooks write to a staging folder. Only what a notebook that ran to its end has left there is
moved to where results live, file by file, each by a rename; so a failed or interrupted run leaves
the results of earlier ones as they were. A notebook that keeps checkpoints finds them again when it
is next run with the same inputs.

Freshness is judged by content, not by times: a notebook is fresh when everything it depends on has
the hash it had, and everything it produced is still there unchanged.
"""

import hashlib
import json
import platform
import shutil
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from robsmooth._support import cluster, files
from robsmooth._support.extras import check_installed, extra
from robsmooth.workbench import parameters as parameters_cell
from robsmooth.workbench import provenance
from robsmooth.workbench.execution import Execution, Failure
from robsmooth.workbench.parameters import OPTIONAL, SET_BY_PIPELINE, PipelineError, unknown

PROFILES = ("paper", "quick")
NEEDED = ("ipykernel", "matplotlib", "nbformat", "papermill", "psutil")  # to run any notebook
PACKAGE = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Places:
    """Where a run's results go, and where it works."""

    figures: Path
    data: Path
    work: Path

    @classmethod
    def of(cls, root: Path, profile: str, custom: bool = False, build: Path | None = None):
        """Choose the places of a run: only the paper's own values reach figures/ and data/."""
        work = (build or root / "build") / ("custom" if custom else profile)
        results = root if profile == "paper" and not custom else work
        return cls(results / "figures", results / "data", work)


@dataclass(frozen=True)
class NotebookResult:
    """What became of one notebook."""

    name: str
    status: str  # "done", "fresh" or "failed"
    seconds: float
    files: tuple[str, ...]
    executed: Path
    failure: Failure | None = None


@dataclass(frozen=True)
class Task:
    """A notebook, its checked parameter values, and the hash of all that its results depend on.

    `optional` are those of `parameters.OPTIONAL` that it has.
    """

    name: str
    path: Path
    values: Mapping[str, object]
    seed: object
    key: str
    optional: tuple[str, ...]


def run_notebooks(
    root: Path,
    only: Sequence[str] = (),
    profile: str = "paper",
    parameters: Mapping[str, object] | None = None,
    jobs: int = 2,
    force: bool = False,
    time_limit: float = 1800.0,
    build: Path | None = None,
    scheduler: str = "",
    started: Callable[[int], None] = lambda count: None,
    finished: Callable[[NotebookResult], None] = lambda result: None,
) -> list[NotebookResult]:
    """Run notebooks, each in a process of its own, all of them even when some fail.

    Parameters
    ----------
    root : Path
        Folder of the project, with its `notebooks/`.
    only : sequence of str
        Names, or parts of names that fit one notebook only; empty for all.
    profile : {"paper", "quick"}
        Whose values in `notebooks/profiles.toml` to use.
    parameters : mapping, optional
        Values that override the profile's, in every selected notebook that has them. The results
        of such a run go to `build/custom/`.
    jobs : int
        Notebooks to run at a time.
    force : bool
        Whether to run the fresh ones, too.
    time_limit : float
        Seconds for a notebook; a cell may take half as long.
    build : Path, optional
        Folder to work in instead of `root/build`.
    scheduler : str
        Address of a Dask scheduler for the notebooks that can use one; empty for this machine. The
        results are the same, and those that are fresh stay fresh.
    started : callable
        Called with the number of notebooks, once all is checked.
    finished : callable
        Called with each result as it comes.

    Returns
    -------
    list of NotebookResult
        In the order of the notebooks' names.

    Raises
    ------
    PipelineError
        Where the run cannot be made as asked for; nothing has been run then.
    MissingExtraError
        Where what runs notebooks is not installed.
    """
    with extra("notebooks", "a run of the notebooks"):
        check_installed(*NEEDED)
    if jobs < 1:
        raise PipelineError(f"jobs must be 1 or more, not {jobs}")
    if not time_limit > 0:
        raise PipelineError(f"time_limit must be a positive number of seconds, not {time_limit}")
    places = Places.of(root, profile, bool(parameters), build)
    tasks = plan(root, only, profile, parameters or {})
    _check_scheduler(scheduler)
    started(len(tasks))
    results = []
    with _alone(places.work):
        waiting = []
        for task in tasks:
            produced = None if force else _fresh(task, places)
            if produced is None:
                waiting.append(task)
            else:
                results.append(_result(task, places, "fresh", 0.0, produced))
                finished(results[-1])
        with closing(_run(waiting, places, profile, jobs, time_limit, scheduler)) as running:
            for result in running:
                results.append(result)
                finished(result)
    return sorted(results, key=lambda result: result.name)


def plan(
    root: Path, only: Sequence[str], profile: str, overrides: Mapping[str, object]
) -> list[Task]:
    """Select the notebooks and check every value given for their parameters."""
    if profile not in PROFILES:
        raise PipelineError(f"profile must be one of {', '.join(PROFILES)}, not {profile}")
    folder = root / "notebooks"
    profiles = _profiles(folder)
    names = select(profiles["notebooks"], only)
    known = {name: parameters_cell.read(folder / f"{name}.ipynb") for name in names}
    for name in overrides:
        if not any(name in parameters for parameters in known.values()):
            everywhere = sorted(
                {key for each in known.values() for key in each} - {*SET_BY_PIPELINE}
            )
            raise unknown("--set: parameter", name, everywhere)
    tasks = []
    for name, parameters in known.items():
        own = {key: value for key, value in overrides.items() if key in parameters}
        values = {
            **({"profile": profile} if "profile" in parameters else {}),
            **parameters_cell.check(
                parameters, profiles[profile].get(name, {}), f"profiles.toml, [{profile}.{name}]"
            ),
            **parameters_cell.check(parameters, own, f"--set for {name}"),
        }
        defaults = {key: parameter.default for key, parameter in parameters.items()}
        path = folder / f"{name}.ipynb"
        seed = {**defaults, **values}.get("seed")
        key = _key(root, path, profile, values)
        optional = tuple(each for each in OPTIONAL if each in parameters)
        tasks.append(Task(name, path, values, seed, key, optional))
    return tasks


def select(names: Sequence[str], only: Sequence[str]) -> list[str]:
    """Those of `names` that `only` asks for, each by its name, its start, or a part of it."""
    chosen = set()
    for wanted in only:
        for fits in (str.__eq__, str.startswith, str.__contains__):
            found = [name for name in names if fits(name, wanted)]
            if found:
                break
        if not found:
            raise unknown("--only: notebook", wanted, names)
        if len(found) > 1:
            raise PipelineError(f"--only: {wanted} fits several notebooks: {', '.join(found)}")
        chosen.update(found)
    return [name for name in names if name in chosen or not only]


def _profiles(folder: Path) -> dict:
    """`profiles.toml`, checked against the notebooks that there are."""
    path = folder / "profiles.toml"
    try:
        profiles = tomllib.loads(path.read_text())
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise PipelineError(f"notebooks/profiles.toml cannot be read: {error}") from error
    listed = sorted(profiles.setdefault("notebooks", []))
    there = {path.stem for path in folder.glob("*.ipynb")}
    for name in sorted({*listed} - there):
        raise PipelineError(f"notebooks/{name}.ipynb is missing; profiles.toml lists it")
    numbered = {path.stem for path in folder.glob("[0-9][0-9]_*.ipynb")}  # others may be a user's
    for name in sorted(numbered - {*listed}):
        raise PipelineError(f"notebooks/{name}.ipynb is not listed in profiles.toml")
    for profile in PROFILES:
        for name in profiles.setdefault(profile, {}):
            if name not in listed:
                raise unknown(f"profiles.toml, [{profile}]: notebook", name, listed)
    profiles["notebooks"] = listed
    return profiles


def _key(root: Path, notebook: Path, profile: str, values: Mapping[str, object]) -> str:
    """Hash of all that a notebook's results depend on."""
    sources = [path for path in PACKAGE.rglob("*") if path.suffix in {".py", ".pyi", ".mplstyle"}]
    inputs = [root / "data/published.toml", root / provenance.LOCK]
    digests = {
        str(path.relative_to(PACKAGE.parent)): provenance.sha256(path) for path in sorted(sources)
    }
    digests |= {path.name: provenance.sha256(path) for path in inputs if path.is_file()}
    digests[notebook.name] = provenance.sha256(notebook)
    environment = [platform.python_version(), platform.system(), platform.machine()]
    text = json.dumps([digests, environment, profile, values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _fresh(task: Task, places: Places) -> tuple[str, ...] | None:
    """Files the notebook produced, if it need not be run again."""
    try:
        stamp = json.loads(_stamp(task, places).read_text())
        same = stamp["key"] == task.key and all(
            provenance.sha256(_place(file, places)) == digest
            for file, digest in stamp["files"].items()
        )
        return tuple(stamp["files"]) if same else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None  # never run, or its stamp or results are gone or damaged


def _check_scheduler(address: str) -> None:
    """Connect to the scheduler once: here an error is one sentence, and comes at once."""
    try:
        with cluster.connect(address):
            pass
    except (ConnectionError, ImportError, ValueError) as error:
        raise PipelineError(f"--dask: {error}") from error


def _run(
    tasks: Sequence[Task],
    places: Places,
    profile: str,
    jobs: int,
    time_limit: float,
    scheduler: str,
) -> Iterator[NotebookResult]:
    """Run tasks, `jobs` at a time; whatever ends this early ends all that it has started."""
    waiting, running = list(tasks), {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                task = waiting.pop(0)
                running[task.name] = task, _start(task, places, time_limit, scheduler)
            for name, (task, execution) in list(running.items()):
                if execution.finished():
                    yield _finish(task, execution, places, profile)
                    del running[name]
            time.sleep(0.05)
    finally:
        for _, execution in running.values():
            execution.kill()
        shutil.rmtree(places.work / "staging", ignore_errors=True)


def _start(task: Task, places: Places, time_limit: float, scheduler: str) -> Execution:
    staging = places.work / "staging" / task.name
    shutil.rmtree(staging, ignore_errors=True)
    for folder in ("figures", "data", "scratch"):
        (staging / folder).mkdir(parents=True)
    _clear_checkpoints(task, places, keep=_checkpoints(task, places))
    values = {
        **task.values,
        "output_dir": str(staging / "figures"),
        "data_dir": str(staging / "data"),
    }
    if "scheduler" in task.optional:
        values["scheduler"] = scheduler
    if "checkpoint_dir" in task.optional:
        _checkpoints(task, places).mkdir(parents=True, exist_ok=True)
        values["checkpoint_dir"] = str(_checkpoints(task, places))
    executed = places.work / "notebooks" / f"{task.name}.ipynb"
    return Execution(task.path, executed, values, staging / "scratch", time_limit)


def _finish(task: Task, execution: Execution, places: Places, profile: str) -> NotebookResult:
    seconds, failure = execution.seconds, execution.failure()
    if failure:
        return _result(task, places, "failed", seconds, (), failure)
    produced = _publish(task, execution, places, profile)
    _clear_checkpoints(task, places)
    return _result(task, places, "done", seconds, produced)


def _publish(task: Task, execution: Execution, places: Places, profile: str) -> tuple[str, ...]:
    """Move what the notebook has produced to its place, with its provenance and a stamp."""
    staging = places.work / "staging" / task.name
    produced = {
        path.relative_to(staging).as_posix(): provenance.sha256(path)
        for folder in ("figures", "data")
        for path in sorted((staging / folder).rglob("*"))
        if path.is_file()
    }
    about = places.figures / f"{task.name}.provenance.json"
    _stamp(task, places).unlink(missing_ok=True)
    for file in produced:
        with files.atomic_path(_place(file, places)) as temporary:
            shutil.move(staging / file, temporary)
    for file in _listed(about) - produced.keys():
        _place(file, places).unlink(missing_ok=True)
    provenance.write(
        places.figures / task.name,
        notebook=f"{task.name}.ipynb",
        profile=profile,
        parameters=task.values,
        files=produced,
        seed=task.seed,
        started=execution.started,
    )
    produced[f"figures/{about.name}"] = provenance.sha256(about)
    files.write_json(_stamp(task, places), {"key": task.key, "files": produced})
    return tuple(produced)


def _listed(about: Path) -> set[str]:
    """Files that the notebook's last run produced; those it no longer does are removed."""
    try:
        return {
            file
            for file in json.loads(about.read_text())["files"]
            if file.startswith(("figures/", "data/")) and ".." not in file
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return set()


def _place(file: str, places: Places) -> Path:
    folder, _, name = file.partition("/")
    return {"figures": places.figures, "data": places.data}[folder] / name


def _checkpoints(task: Task, places: Places) -> Path:
    """Folder that a notebook resumes from: another one for each state of its inputs."""
    return places.work / "checkpoints" / f"{task.name}-{task.key[:16]}"


def _clear_checkpoints(task: Task, places: Places, keep: Path | None = None) -> None:
    for folder in (places.work / "checkpoints").glob("*-*"):
        if folder.name.rpartition("-")[0] == task.name and folder != keep:
            shutil.rmtree(folder, ignore_errors=True)


def _stamp(task: Task, places: Places) -> Path:
    return places.work / "stamps" / f"{task.name}.json"


def _result(
    task: Task,
    places: Places,
    status: str,
    seconds: float,
    produced: tuple[str, ...],
    failure: Failure | None = None,
) -> NotebookResult:
    executed = places.work / "notebooks" / f"{task.name}.ipynb"
    return NotebookResult(task.name, status, seconds, produced, executed, failure)


@contextmanager
def _alone(work: Path) -> Iterator[None]:
    """Keep a second run out of the same folder."""
    work.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(files.exclusive_lock(work / "lock"))
        except BlockingIOError as error:
            raise PipelineError(f"another run is at work in {work}; wait for it") from error
        yield
