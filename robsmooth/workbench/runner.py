"""Run the notebooks that are not fresh, and publish what succeeds, as environment.md says."""

import hashlib
import json
import platform
import secrets
import shutil
import sqlite3
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from pathlib import Path

from robsmooth._support import cluster, files
from robsmooth._support.extras import extra
from robsmooth.workbench import execution as processes
from robsmooth.workbench import parameters as cell
from robsmooth.workbench import provenance
from robsmooth.workbench.dependencies import dependencies, modules_in
from robsmooth.workbench.parameters import SET_BY_PIPELINE, PipelineError, unknown
from robsmooth.workbench.provenance import sha256

PROFILES = ("paper", "quick")
NEEDED = ("ipykernel", "matplotlib", "nbformat", "papermill", "psutil")  # to run any notebook
FOLDERS = ("figures", "data")  # of results
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
            raise PipelineError(f"time_limit must be in (0, 1e6] s, not {self.time_limit}")

    @property
    def work(self) -> Path:
        """Folder that the run works in."""
        build = self.build or self.root / "build"
        return build.absolute() / ("custom" if self.parameters else self.profile)

    @property
    def lock(self) -> Path:
        """File whose lock keeps other runs off the folders that this one writes to."""
        return (self.root / "build/paper" if self.results == self.root else self.work) / "lock"

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
    staging: Path  # folder that it writes to, of this run alone
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


def run_notebooks(run: Request, tasks: list[Task], stop: Sequence = ()) -> Iterator[NotebookResult]:
    """Run each task in its own process; yield the results. Ends early once `stop` has an item."""
    waiting, running = {}, {}
    with ExitStack() as stack:
        try:
            stack.enter_context(files.exclusive_lock(run.lock))
        except sqlite3.Error as error:
            raise PipelineError(f"{run.lock} cannot be locked: {error}") from error
        _clean(run)
        stack.callback(_clean, run)
        for task in tasks:
            if run.force or (produced := _fresh(task)) is None:
                waiting[task.name] = task
            else:
                yield NotebookResult(task, "fresh", produced)
        while (waiting or running) and not stop:
            while waiting and len(running) < run.jobs:
                task = waiting.pop(next(iter(waiting)))
                try:
                    running[task.name] = task, _start(task)
                except OSError as error:
                    failure = f"it could not be started: {error}"
                    yield NotebookResult(task, "failed", failure=failure)
            for task, execution in list(running.values()):
                if execution.finished():
                    yield _finish(task, execution, _taken(run, waiting.keys() | running.keys()))
                    del running[task.name]
            time.sleep(0.05)


def _clean(run: Request) -> None:
    """End what this run or an earlier one left running, and remove what it left unpublished."""
    processes.end_all(run.work / "staging")
    shutil.rmtree(run.work / "staging", ignore_errors=True)
    for folder in (run.work, *(run.results / name for name in FOLDERS)):
        for path in folder.rglob(f"*{_UNPUBLISHED}"):
            path.unlink()


def _taken(run: Request, unfinished: set[str]) -> dict[str, str]:
    """Return the files that no unfinished notebook may write, and whose they are."""
    taken = dict.fromkeys(provenance.INPUTS, "an input of the notebooks")
    for name in {path.stem for path in (run.root / "notebooks").glob("*.ipynb")}:
        there = {} if name in unfinished else _stored(run.work / f"stamps/{name}.json")[1]
        taken |= dict.fromkeys(there, f"a file of {name}")
        taken[f"figures/{name}.provenance.json"] = f"the provenance of {name}"
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
    for name in run.parameters.keys() - everywhere:
        raise unknown("--set: parameter", name, everywhere - {*SET_BY_PIPELINE})
    tasks = []
    for name, each in known.items():
        own = {key: value for key, value in run.parameters.items() if key in each}
        given = profiles.get(run.profile, {}).get(name, {})
        values = cell.check(each, given, f"profiles.toml, [{run.profile}.{name}]")
        values |= cell.check(each, own, f"--set for {name}")
        notebook = folder / f"{name}.ipynb"
        key = _key(run, notebook, values)
        task = Task(
            *(run, name, each, values, key, notebook),
            staging=run.work / "staging" / f"{name}.{secrets.token_hex(4)}",
            executed=run.work / "notebooks" / notebook.name,
            stamp=run.work / "stamps" / f"{name}.json",
            checkpoints=run.work / "checkpoints" / name / key[:16],
        )
        tasks.append(task)
    try:
        with cluster.connect(run.dask, allow_insecure=run.allow_insecure):
            pass
    except (ConnectionError, ImportError) as error:
        raise PipelineError(f"--dask: {error}") from error
    return tasks


def select(names: Sequence[str], only: Sequence[str]) -> list[str]:
    """Return the names that contain a part in `only`; all names where it is empty."""
    for part in only:
        if not any(part in name for name in names):
            raise unknown("--only: notebook", part, names)
    return [name for name in names if not only or any(part in name for part in only)]


def _profiles(folder: Path) -> dict:
    """Return `profiles.toml`, checked against the notebooks in the folder."""
    import jsonschema  # comes with nbformat

    name = {"enum": sorted(path.stem for path in folder.glob("*.ipynb"))}
    table = {"type": "object", "additionalProperties": {"type": "object"}, "propertyNames": name}
    names = {"type": "array", "items": name, "uniqueItems": True}
    tables = {"notebooks": names, **dict.fromkeys(PROFILES, table)}
    try:
        profiles = tomllib.loads((folder / "profiles.toml").read_text(encoding="utf-8"))
        schema = {"properties": tables, "required": ["notebooks"]}
        jsonschema.Draft202012Validator(schema).validate(profiles)  # to the first of its errors
    except jsonschema.ValidationError as error:
        raise PipelineError(f"profiles.toml, {error.json_path}: {error.message:.200}") from error
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        why = str(error) or type(error).__name__
        raise PipelineError(f"notebooks/profiles.toml cannot be read: {why:.200}") from error
    numbered = {path.name for path in folder.glob("[0-9][0-9]_*.ipynb")}  # others may be a user's
    for file in numbered - {f"{name}.ipynb" for name in profiles["notebooks"]}:
        raise PipelineError(f"notebooks/{file} is not listed in profiles.toml")
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


def _stored(stamp: Path) -> tuple[str, dict[str, str]]:
    """Return the key and the files' digests of a stamp; nothing from a damaged one."""
    try:
        stored = json.loads(stamp.read_text(encoding="utf-8"))
        return stored.get("key", ""), {file: str(text) for file, text in stored["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return "", {}


def _unchanged(run: Request, digests: Mapping[str, str]) -> dict[str, str]:
    """Return those of a stamp's files that are as it says: no input, nothing behind a link."""
    paths = [path for name in FOLDERS for path in (run.results / name).rglob("*")]
    there = {path.relative_to(run.results).as_posix(): path for path in paths if path.is_file()}
    named = digests.keys() & there.keys() - {*provenance.INPUTS}
    return {file: digests[file] for file in named if sha256(there[file]) == digests[file]}


def _fresh(task: Task) -> tuple[str, ...] | None:
    """Return the files of the last run if it need not be repeated, else None."""
    key, digests = _stored(task.stamp)
    return tuple(digests) if key == task.key and _unchanged(task.run, digests) == digests else None


def _start(task: Task) -> processes.Execution:
    for folder in FOLDERS:
        (task.staging / folder).mkdir(parents=True)
    if not task.checkpoints.exists():  # those beside it are of other inputs
        shutil.rmtree(task.checkpoints.parent, ignore_errors=True)
    if "checkpoint_dir" in task.parameters:
        task.checkpoints.mkdir(parents=True, exist_ok=True)
    ours = {"scheduler": task.run.dask, "checkpoint_dir": str(task.checkpoints)}
    ours["allow_insecure"] = task.run.allow_insecure
    ours |= {"output_dir": str(task.staging / "figures"), "data_dir": str(task.staging / "data")}
    values = {**task.values, **{name: ours[name] for name in ours if name in task.parameters}}
    return processes.Execution(task.notebook, values, task.staging, task.run.time_limit)


def _finish(task: Task, execution: processes.Execution, taken: Mapping[str, str]) -> NotebookResult:
    """Keep the executed copy, and publish what the notebook produced, or say why not."""
    produced, seconds, failure = (), execution.seconds, execution.failure()
    try:
        if execution.executed.exists():
            with _put(task.executed) as temporary:
                shutil.move(execution.executed, temporary)
        if not failure:
            produced = _publish(task, execution.started, taken)
    except (OSError, ValueError) as error:
        failure = failure or f"its files were not published: {error}"
    return NotebookResult(task, "failed" if failure else "done", produced, seconds, failure)


def _publish(task: Task, started: float, taken: Mapping[str, str]) -> tuple[str, ...]:
    """Move what a notebook produced to its places; return the files, with the provenance."""
    run, produced = task.run, _produced(task, taken)
    if _key(run, task.notebook, task.values) != task.key:
        raise ValueError("what they depend on changed in the meantime: run it again")
    defaults = {name: each.default for name, each in task.parameters.items()}
    about = {"notebook": task.notebook.name, "profile": run.profile, "parameters": task.values}
    about |= {"files": produced, "seed": (defaults | task.values).get("seed"), "started": started}
    before = _unchanged(run, _stored(task.stamp)[1])
    with _put(task.stamp) as unfinished:  # without a key: what a kill leaves is ours, and not fresh
        files.write_json(unfinished, {"key": "", "files": before | produced})
    # All is written beside its place; then the provenance is away until the rest is in its place:
    # contexts are left in the order opposite to that in which they were entered.
    with ExitStack() as stack:
        stamp = stack.enter_context(_put(task.stamp))
        file = f"figures/{task.name}.provenance.json"
        written = stack.enter_context(_put(run.results / file))
        files.write_json(written, provenance.collect(**about))
        files.write_json(stamp, {"key": task.key, "files": produced | {file: sha256(written)}})
        for each in produced:
            shutil.move(task.staging / each, stack.enter_context(_put(run.results / each)))
        (run.results / file).unlink(missing_ok=True)
        for each in before.keys() - {*produced, file, *taken}:
            (run.results / each).unlink()
    shutil.rmtree(task.checkpoints.parent, ignore_errors=True)
    return (*produced, file)


def _produced(task: Task, taken: Mapping[str, str]) -> dict[str, str]:
    """Return the digests of the files that a notebook produced; a ValueError where one may not."""
    digests = {}
    for path in [path for name in FOLDERS for path in sorted((task.staging / name).rglob("*"))]:
        file, is_folder = path.relative_to(task.staging).as_posix(), path.is_dir()
        whose = "a folder" if (task.run.results / file).is_dir() else taken.get(file)
        if whose and not is_folder:
            raise ValueError(f"{file} is {whose}")
        is_plain = (is_folder or path.is_file()) and not path.is_symlink()
        if not (is_plain and file.isprintable()) or file.endswith(_UNPUBLISHED):
            raise ValueError(f"{file!r} is not a regular file with a name of printable signs")
        if not is_folder:
            digests[file] = sha256(path)
    return digests
