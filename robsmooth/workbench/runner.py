"""Run the notebooks that are not fresh, and publish what succeeds, as environment.md says."""

import hashlib
import json
import platform
import shutil
import sqlite3
import tempfile
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
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
from robsmooth.workbench.signals import held_back
from robsmooth.workbench.worker import end_all

PROFILES = ("paper", "quick")
NEEDED = ("ipykernel", "matplotlib", "nbformat", "papermill", "psutil")  # to run any notebook
FOLDERS = ("figures", "data")  # of results
# of profiles.toml, as a JSON schema
_TABLES = {"type": "object", "additionalProperties": {"type": "object"}}
_NAME = {"type": "string", "pattern": r"^[^/\x00-\x1f]+$"}
_NAMES = {"type": "array", "items": _NAME, "uniqueItems": True}
_PROFILES = {
    "required": ["notebooks"],
    "properties": {"notebooks": _NAMES, **dict.fromkeys(PROFILES, _TABLES)},
}
_UNPUBLISHED = ".unpublished"  # end of the name of a file that is not in its place yet
_put = partial(files.atomic_path, kept=_UNPUBLISHED)
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
        if not 0 < self.time_limit <= 1e6:
            wanted = "a positive number of seconds, at most 1e6"
            raise PipelineError(f"time_limit must be {wanted}, not {self.time_limit}")

    @property
    def work(self) -> Path:
        """Folder that the run works in."""
        build = self.build or self.root / "build"
        return build.absolute() / ("custom" if self.parameters else self.profile)

    @property
    def locks(self) -> list[Path]:
        """Files whose locks keep other runs off the folders that this one writes to."""
        of_paper = [self.root / "build/paper/lock"] if self.results == self.root else []
        return sorted({path.resolve() for path in [self.work / "lock", *of_paper]})

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
    with held_back() as signals, ExitStack() as stack:
        for lock in run.locks:
            try:
                stack.enter_context(files.exclusive_lock(lock))
            except sqlite3.Error as error:
                raise PipelineError(f"{lock} cannot be locked: {error}") from error
        _clean(run)
        stack.callback(_clean, run)
        for task in tasks:
            if run.force or (produced := _fresh(task)) is None:
                waiting.append(task)
            else:
                yield NotebookResult(task, "fresh", produced)
        taken = _taken(run, waiting)
        try:
            while (waiting or running) and not signals:
                while waiting and len(running) < run.jobs:
                    task = waiting.pop(0)
                    try:
                        running.append((task, _start(task)))
                    except (OSError, ValueError) as error:
                        failure = f"it could not be started: {error}"
                        yield NotebookResult(task, "failed", failure=failure)
                for task, execution in list(running):
                    if execution.finished():
                        running.remove((task, execution))
                        result = _finish(task, execution, taken)
                        taken |= dict.fromkeys(result.files, f"a file of {task.name}")
                        yield result
                time.sleep(0.05)
        finally:
            for _, execution in running:
                execution.kill()


def _clean(run: Request) -> None:
    """End what this run or an earlier one left running, and remove what it left unpublished."""
    end_all(run.work / "staging")
    shutil.rmtree(run.work / "staging", ignore_errors=True)
    folders = [run.work / "stamps", run.work / "notebooks"]
    for folder in [*folders, *(run.results / name for name in FOLDERS)]:
        for path in folder.rglob(f"*{_UNPUBLISHED}"):
            path.unlink()


def _taken(run: Request, waiting: Sequence[Task]) -> dict[str, str]:
    """Return the files that the notebooks of a run must not write, and whose they are."""
    taken = dict.fromkeys(provenance.INPUTS, "an input of the notebooks")
    for notebook in sorted((run.root / "notebooks").glob("*.ipynb")):
        if notebook.stem not in {task.name for task in waiting}:
            there = _stored(run, run.work / "stamps" / f"{notebook.stem}.json")[1]
            taken |= dict.fromkeys(there, f"a file of {notebook.stem}")
        taken[f"figures/{notebook.stem}.provenance.json"] = f"the provenance of {notebook.stem}"
    return taken


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
    import jsonschema  # comes with nbformat

    try:
        profiles = tomllib.loads((folder / "profiles.toml").read_text(encoding="utf-8"))
        jsonschema.validate(profiles, _PROFILES)
    except jsonschema.ValidationError as error:
        raise PipelineError(f"profiles.toml, {error.json_path}: {error.message:.200}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise PipelineError(f"notebooks/profiles.toml cannot be read: {error}") from error
    listed = profiles["notebooks"]
    for path in sorted(folder.glob("[0-9][0-9]_*.ipynb")):  # other names may be a user's
        if path.stem not in listed:
            raise PipelineError(f"notebooks/{path.name} is not listed in profiles.toml")
    for profile in PROFILES:
        for name in profiles.setdefault(profile, {}):
            if name not in listed:
                raise unknown(f"profiles.toml, [{profile}]: notebook", name, listed)
    return profiles


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


def _stored(run: Request, stamp: Path) -> tuple[str, dict[str, str]]:
    """Return the key and the files' digests of a stamp; nothing from a damaged one."""
    try:
        stored = json.loads(stamp.read_text(encoding="utf-8"))
        key, digests = stored["key"], stored["files"]
        texts = {key, *digests, *digests.values()}
        if all(isinstance(text, str) for text in texts) and all(_is_own(run, f) for f in digests):
            return key, digests
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        pass
    return "", {}


def _is_own(run: Request, file: str) -> bool:
    """Whether a path is of results, also behind symbolic links, and not of an input."""
    path = run.results / file
    path = path.parent.resolve() / path.name
    inputs = [(run.root / name).resolve() for name in provenance.INPUTS]
    folders = [(run.results / name).resolve() for name in FOLDERS]
    return path not in inputs and any(folder in path.parents for folder in folders)


def _fresh(task: Task) -> tuple[str, ...] | None:
    """Return the files of the last run if it need not be repeated, else None."""
    key, digests = _stored(task.run, task.stamp)
    same = all(_has(task.run.results / file, digest) for file, digest in digests.items())
    return tuple(digests) if key == task.key and same else None


def _has(path: Path, digest: str) -> bool:
    return path.is_file() and sha256(path) == digest


def _start(task: Task) -> Execution:
    place = task.run.work / "staging"
    place.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=f"{task.name}.", dir=place))
    for folder in FOLDERS:
        (staging / folder).mkdir()
    if not task.checkpoints.exists():  # those beside it are of other inputs
        shutil.rmtree(task.checkpoints.parent, ignore_errors=True)
    if "checkpoint_dir" in task.parameters:
        task.checkpoints.mkdir(parents=True, exist_ok=True)
    ours = {"scheduler": task.run.dask, "checkpoint_dir": str(task.checkpoints)}
    ours["allow_insecure"] = task.run.allow_insecure
    ours |= {"output_dir": str(staging / "figures"), "data_dir": str(staging / "data")}
    values = {**task.values, **{name: ours[name] for name in ours if name in task.parameters}}
    return Execution(task.notebook, values, staging, task.run.time_limit)


def _finish(task: Task, execution: Execution, taken: Mapping[str, str]) -> NotebookResult:
    """Publish what the notebook produced, or say why not."""
    seconds, failure = execution.seconds, execution.failure()
    try:
        if not failure:
            produced = _publish(task, execution, taken)
            return NotebookResult(task, "done", produced, seconds)
    except (OSError, ValueError) as error:
        failure = f"its files were not published: {error}"
    with suppress(OSError), _put(task.executed) as temporary:
        shutil.move(execution.executed, temporary)
    return NotebookResult(task, "failed", (), seconds, failure)


def _publish(task: Task, execution: Execution, taken: Mapping[str, str]) -> tuple[str, ...]:
    """Move what a notebook produced to its places; return the files, with the provenance.

    All is written beside its place first. Then there is no provenance until all is in its place:
    contexts are left in the order opposite to that in which they were entered.
    """
    run, produced = task.run, _produced(task, execution.staging, taken)
    if _key(run, task.notebook, task.values) != task.key:
        raise ValueError("what they depend on changed in the meantime: run it again")
    defaults = {name: each.default for name, each in task.parameters.items()}
    about = {"notebook": task.notebook.name, "profile": run.profile}
    about |= {"parameters": task.values, "files": produced}
    about |= {"seed": (defaults | task.values).get("seed"), "started": execution.started}
    before = _stored(run, task.stamp)[1]
    with _put(task.stamp) as unfinished:  # without a key: what a kill leaves is ours, and not fresh
        files.write_json(unfinished, {"key": "", "files": before | produced})
    with ExitStack() as stack:
        stamp = stack.enter_context(_put(task.stamp))
        file = f"figures/{task.name}.provenance.json"
        written = stack.enter_context(_put(run.results / file))
        files.write_json(written, provenance.collect(**about))
        files.write_json(stamp, {"key": task.key, "files": produced | {file: sha256(written)}})
        for each in produced:
            shutil.move(execution.staging / each, stack.enter_context(_put(run.results / each)))
        shutil.move(execution.executed, stack.enter_context(_put(task.executed)))
        (run.results / file).unlink(missing_ok=True)
        for each in before.keys() - {*produced, file, *taken}:
            if _has(run.results / each, before[each]):  # else someone has changed it
                (run.results / each).unlink()
    shutil.rmtree(task.checkpoints.parent, ignore_errors=True)
    return (*produced, file)


def _produced(task: Task, staging: Path, taken: Mapping[str, str]) -> dict[str, str]:
    """Return the digests of the files that a notebook produced; a ValueError where one may not."""
    digests = {}
    for path in [path for name in FOLDERS for path in sorted((staging / name).rglob("*"))]:
        file = path.relative_to(staging).as_posix()
        if path.is_dir() and not path.is_symlink():
            continue
        if file in taken:
            raise ValueError(f"{file} is {taken[file]}")
        is_regular = path.is_file() and not path.is_symlink() and path.suffix != _UNPUBLISHED
        if not (is_regular and file.isprintable() and _is_own(task.run, file)):
            raise ValueError(f"{file!r} is not a regular file with a name of printable signs")
        digests[file] = sha256(path)
    return digests
