"""Run the notebooks that are not fresh, and publish what succeeds, as environment.md says."""

import hashlib
import json
import platform
import shutil
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path

from robsmooth._support import cluster, files
from robsmooth._support.extras import extra
from robsmooth.workbench import parameters as cell
from robsmooth.workbench import provenance
from robsmooth.workbench.dependencies import dependencies, modules_in
from robsmooth.workbench.execution import Execution
from robsmooth.workbench.parameters import SET_BY_PIPELINE, PipelineError, unknown
from robsmooth.workbench.provenance import sha256

PROFILES = ("paper", "quick")
NEEDED = ("ipykernel", "matplotlib", "nbformat", "papermill", "psutil")  # to run any notebook
PACKAGE = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Request:
    """What is asked of a run."""

    root: Path  # of the project, which holds notebooks/
    only: Sequence[str] = ()  # parts of names of notebooks; empty for all
    profile: str = "paper"  # a table of notebooks/profiles.toml
    parameters: Mapping[str, object] = field(default_factory=dict)  # instead of the profile's
    jobs: int = 2  # notebooks at a time
    time_limit: float = 1800.0  # s for a notebook; a cell may take half as long
    force: bool = False  # whether to run fresh notebooks
    dask: str = ""  # address of a scheduler, which changes no result; empty for this machine
    allow_insecure: bool = False  # whether it may be off the loopback without TLS
    build: Path | None = None  # folder to work in; None for root/build

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise PipelineError(f"jobs must be 1 or more, not {self.jobs}")
        if not self.time_limit > 0:
            wanted = "a positive number of seconds"
            raise PipelineError(f"time_limit must be {wanted}, not {self.time_limit}")

    @property
    def work(self) -> Path:
        """Folder that the run works in."""
        build = self.build or self.root / "build"
        return build.absolute() / ("custom" if self.parameters else self.profile)

    @property
    def results(self) -> Path:
        """Folder of figures/ and data/: only the paper's own values write to the project's."""
        return self.root if self.profile == "paper" and not self.parameters else self.work


@dataclass(frozen=True)
class Task:
    """A notebook of a run."""

    run: Request
    name: str
    parameters: Mapping[str, cell.Parameter]
    values: Mapping[str, object]  # given for its parameters, checked
    key: str  # hash of all that its results depend on
    notebook: Path
    executed: Path  # its executed copy
    staging: Path  # folder that it writes to
    stamp: Path  # file of the key and the files of its last run
    checkpoints: Path  # folder that it resumes from, one for each key


@dataclass(frozen=True)
class NotebookResult:
    """The outcome of one notebook."""

    task: Task
    status: str  # "done", "fresh" or "failed"
    files: tuple[str, ...] = ()  # such as "figures/name.pdf"
    seconds: float = 0.0
    failure: str = ""


def run_notebooks(run: Request, tasks: Sequence[Task]) -> Iterator[NotebookResult]:
    """Run each task in its own process; yield results as they come. Closing it ends them all."""
    waiting, running = [], []
    with files.exclusive_lock(run.work / "lock"):
        for task in tasks:
            if run.force or (produced := _fresh(task)) is None:
                waiting.append(task)
            else:
                yield NotebookResult(task, "fresh", produced)
        try:
            while waiting or running:
                while waiting and len(running) < run.jobs:
                    running.append((waiting[0], _start(waiting.pop(0))))
                for task, execution in list(running):
                    if execution.finished():
                        running.remove((task, execution))
                        yield _finish(task, execution)
                time.sleep(0.05)
        finally:
            for _, execution in running:
                execution.kill()
            shutil.rmtree(run.work / "staging", ignore_errors=True)


def plan(run: Request) -> list[Task]:
    """Select the notebooks, and check all that can be checked before anything runs."""
    with extra("notebooks", "a run of the notebooks"):
        for package in NEEDED:
            metadata.version(package)  # without an import; an error where it is not installed
    folder = run.root / "notebooks"
    profiles = _profiles(folder)
    names = select(profiles["notebooks"], run.only)
    known = {name: cell.read(folder / f"{name}.ipynb") for name in names}
    everywhere = {parameter for each in known.values() for parameter in each}
    for name in run.parameters:
        if name not in everywhere:
            raise unknown("--set: parameter", name, everywhere - {*SET_BY_PIPELINE})
    tasks = [_task(run, name, each, profiles[run.profile]) for name, each in known.items()]
    try:
        with cluster.connect(run.dask, allow_insecure=run.allow_insecure):
            pass
    except (ConnectionError, ImportError) as error:
        raise PipelineError(f"--dask: {error}") from error
    return tasks


def _task(
    run: Request, name: str, parameters: Mapping[str, cell.Parameter], profile: Mapping[str, dict]
) -> Task:
    own = {key: value for key, value in run.parameters.items() if key in parameters}
    where = f"profiles.toml, [{run.profile}.{name}]"
    values = cell.check(parameters, profile.get(name, {}), where)
    values |= cell.check(parameters, own, f"--set for {name}")
    notebook = run.root / "notebooks" / f"{name}.ipynb"
    key = _key(run, notebook, values)
    return Task(
        *(run, name, parameters, values, key, notebook),
        executed=run.work / "notebooks" / notebook.name,
        staging=run.work / "staging" / name,
        stamp=run.work / "stamps" / f"{name}.json",
        checkpoints=run.work / "checkpoints" / name / key[:16],
    )


def select(names: Sequence[str], only: Sequence[str]) -> list[str]:
    """Return the names that contain a part in `only`; all names where it is empty."""
    for part in only:
        if not any(part in name for name in names):
            raise unknown("--only: notebook", part, names)
    return [name for name in names if not only or any(part in name for part in only)]


def _profiles(folder: Path) -> dict:
    """Return `profiles.toml`, checked against the notebooks in the folder."""
    try:
        profiles = tomllib.loads((folder / "profiles.toml").read_text())
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise PipelineError(f"notebooks/profiles.toml cannot be read: {error}") from error
    listed = profiles.get("notebooks", [])
    for path in sorted(folder.glob("[0-9][0-9]_*.ipynb")):  # other names may be a user's
        if path.stem not in listed:
            raise PipelineError(f"notebooks/{path.name} is not listed in profiles.toml")
    for profile in PROFILES:
        for name in profiles.setdefault(profile, {}):
            if name not in listed:
                raise unknown(f"profiles.toml, [{profile}]: notebook", name, listed)
    return profiles | {"notebooks": listed}


def _key(run: Request, notebook: Path, values: Mapping[str, object]) -> str:
    modules = modules_in(PACKAGE)
    code = "\n".join(each.source for each in cell.code_cells(notebook))
    used = dependencies(f"import {__name__}\n{code}", modules)
    sources = [path for path in PACKAGE.rglob("*") if path.suffix in {".pyi", ".mplstyle"}]
    sources += [modules[name] for name in used]
    inputs = [*(run.root / name for name in provenance.INPUTS), notebook]
    named = {str(path.relative_to(PACKAGE.parent)): path for path in sources}
    named |= {path.name: path for path in inputs if path.is_file()}
    digests = {name: sha256(path) for name, path in named.items()}
    environment = [platform.python_version(), platform.system(), platform.machine()]
    text = json.dumps([digests, environment, run.profile, values], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _stored(path: Path) -> tuple[str, dict[str, str]]:
    """Return the key and the files' digests of a stamp; nothing from a damaged one."""
    try:
        stored = json.loads(path.read_text())
        return stored.get("key", ""), {**stored["files"]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return "", {}


def _fresh(task: Task) -> tuple[str, ...] | None:
    """Return the files of the last run if it need not be repeated, else None."""
    key, digests = _stored(task.stamp)
    there = {task.run.results / file: digest for file, digest in digests.items()}
    same = all(path.is_file() and sha256(path) == digest for path, digest in there.items())
    return tuple(digests) if key == task.key and same else None


def _start(task: Task) -> Execution:
    shutil.rmtree(task.staging, ignore_errors=True)
    for folder in ("figures", "data", "scratch"):
        (task.staging / folder).mkdir(parents=True)
    if not task.checkpoints.exists():  # those beside it are of other inputs
        shutil.rmtree(task.checkpoints.parent, ignore_errors=True)
    if "checkpoint_dir" in task.parameters:
        task.checkpoints.mkdir(parents=True, exist_ok=True)
    ours = {"scheduler": task.run.dask, "checkpoint_dir": str(task.checkpoints)}
    ours["allow_insecure"] = task.run.allow_insecure
    ours |= {"output_dir": str(task.staging / "figures"), "data_dir": str(task.staging / "data")}
    values = {**task.values, **{name: ours[name] for name in ours if name in task.parameters}}
    scratch = task.staging / "scratch"
    return Execution(task.notebook, task.executed, values, scratch, task.run.time_limit)


def _finish(task: Task, execution: Execution) -> NotebookResult:
    """Move the files that the notebook produced to their places; add provenance and stamp."""
    seconds, failure = execution.seconds, execution.failure()
    if failure:
        return NotebookResult(task, "failed", (), seconds, failure)
    places = [task.staging / folder for folder in ("figures", "data")]
    paths = [path for place in places for path in sorted(place.rglob("*")) if path.is_file()]
    produced = {path.relative_to(task.staging).as_posix(): sha256(path) for path in paths}
    before = _stored(task.stamp)[1]
    task.stamp.unlink(missing_ok=True)
    for file in produced:
        with files.atomic_path(task.run.results / file) as temporary:
            shutil.move(task.staging / file, temporary)
    defaults = {name: each.default for name, each in task.parameters.items()}
    about = {"notebook": task.notebook.name, "profile": task.run.profile}
    about |= {"parameters": task.values, "files": produced}
    about |= {"seed": (defaults | task.values).get("seed"), "started": execution.started}
    written = provenance.write(task.run.results / "figures" / task.name, **about)
    produced[f"figures/{written.name}"] = sha256(written)
    for file in before.keys() - produced.keys():
        (task.run.results / file).unlink(missing_ok=True)
    files.write_json(task.stamp, {"key": task.key, "files": produced})
    shutil.rmtree(task.checkpoints.parent, ignore_errors=True)
    return NotebookResult(task, "done", tuple(produced), seconds)
