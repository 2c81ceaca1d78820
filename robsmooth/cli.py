"""The `robsmooth` command."""

import argparse
import ast
import signal
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import robsmooth
from robsmooth._support.extras import MissingExtraError
from robsmooth._support.progress import progress_bar
from robsmooth.workbench.parameters import PipelineError
from robsmooth.workbench.runner import PROFILES, NotebookResult, Places, run_notebooks

INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code: 0, 1 for failures, 2 for a wrong request."""
    options = _parser().parse_args(arguments)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return options.command(options)
    except (PipelineError, MissingExtraError) as error:
        print(f"robsmooth: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "robsmooth: interrupted; notebooks that had finished are kept, the results of the"
            " others are as they were",
            file=sys.stderr,
        )
        return INTERRUPTED


def figures(options: argparse.Namespace) -> int:
    """Run the notebooks, and write the report of the reproduction."""
    root, build = _project(), options.build
    parameters = dict(options.set)
    places = Places.of(root, options.profile, bool(parameters), build)
    with progress_bar(unit="notebook", leave=False) as bar:

        def started(count: int) -> None:
            bar.total = count
            bar.refresh()

        def finished(result: NotebookResult) -> None:
            bar.update()
            bar.write(_line(result))

        results = run_notebooks(
            root,
            only=options.only,
            profile=options.profile,
            parameters=parameters,
            jobs=options.jobs,
            force=options.force,
            time_limit=options.time_limit,
            build=build,
            scheduler=options.dask,
            started=started,
            finished=finished,
        )
    failed = [result for result in results if result.failure]
    if failed:
        print(_summary(failed, len(results)), file=sys.stderr)
    changed = any(result.status == "done" for result in results)
    if not parameters and len(failed) < len(results):
        write_report(root, places, changed)
    if failed:
        return 1
    print(f"figures and tables are in {_short(places.figures)}")
    return 0


def write_report(root: Path, places: Places, changed: bool) -> None:
    """Write the report of the reproduction, where a result changed or it is not as it was written.

    The README shows its scorecard at the paper's scale.
    """
    from robsmooth.paper import report

    if not changed and report.is_fresh(places.figures, places.data):
        return

    if not (places.data / "monte_carlo.json").exists():
        # a part of the notebooks was run, in a new place
        print("no report yet: it needs the results of 04_nonlinear_monte_carlo")
        return
    verdicts = report.write(places.figures, places.data)
    if places.figures == root / "figures":
        report.write_scorecard(root / "README.md", verdicts)


def verdicts(options: argparse.Namespace) -> int:
    """Print every printed number of the paper with its verdict."""
    from robsmooth.paper import report
    from robsmooth.paper import verdicts as paper_verdicts

    project = _project_above()
    try:
        print(report.markdown(paper_verdicts.verdicts(project and project / "data")))
    except ValueError as error:  # no Monte Carlo results, or damaged ones
        raise PipelineError(str(error)) from error
    return 0


def bench(options: argparse.Namespace) -> int:
    """Measure the speed of the simulation, and that of its peers, as benchmarks/ has it."""
    flags = [f"--{name}" for name in ("quick", "write") if getattr(options, name)]
    command = [sys.executable, "-m", "benchmarks", "--peers", options.peers, *flags]
    return subprocess.run(command, cwd=_project()).returncode


def site(options: argparse.Namespace) -> int:
    """Build the site from executed notebooks, as docs/ has it."""
    project = _project()
    if find_spec("sphinx") is None:
        raise PipelineError("Sphinx is not installed; `make report` makes an environment with it")
    command = [sys.executable, "-m", "docs", "--profile", options.profile]
    if options.build:
        command += ["--build", str(options.build.resolve())]
    return subprocess.run(command, cwd=project).returncode


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="robsmooth", description=__doc__)
    version = f"robsmooth {robsmooth.__version__}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("figures", help="run the notebooks that are not fresh")
    command.set_defaults(command=figures)
    command.add_argument(
        "--profile",
        choices=PROFILES,
        default="paper",
        help="scale of the run (default: %(default)s); quick writes to build/quick",
    )
    command.add_argument(
        "--only",
        metavar="NAME[,NAME]",
        type=lambda text: [name for name in text.split(",") if name],
        default=[],
        help="notebooks to run, each by its name or a part that fits one only (default: all)",
    )
    command.add_argument(
        "--set",
        metavar="NAME=VALUE",
        type=_setting,
        action="append",
        default=[],
        help="give a parameter a value of your own; the results go to build/custom",
    )
    command.add_argument(
        "--jobs", type=int, default=2, help="notebooks at a time (default: %(default)s)"
    )
    command.add_argument(
        "--time-limit",
        type=float,
        default=1800.0,
        metavar="SECONDS",
        help="for a notebook; a cell may take half as long (default: %(default)g)",
    )
    command.add_argument("--force", action="store_true", help="run the fresh ones, too")
    command.add_argument(
        "--dask",
        default="",
        metavar="ADDRESS",
        help="compute on the cluster of the Dask scheduler at tcp://host:port",
    )
    command.add_argument("--build", type=Path, help="folder to work in (default: build)")

    command = commands.add_parser("verdicts", help="every printed number with its verdict")
    command.set_defaults(command=verdicts)

    command = commands.add_parser(
        "report", help="build the offline site from what `figures` has left"
    )
    command.set_defaults(command=site)
    command.add_argument(
        "--profile", choices=PROFILES, default="paper", help="whose results (default: %(default)s)"
    )
    command.add_argument("--build", type=Path, help="folder that the run worked in")

    command = commands.add_parser("bench", help="measure the speed of the simulation")
    command.set_defaults(command=bench)
    command.add_argument("--quick", action="store_true", help="in seconds; ratios mean little")
    command.add_argument(
        "--write", action="store_true", help="write benchmarks/results.* and the README's block"
    )
    command.add_argument(
        "--peers", default="", metavar="NAME[,NAME]", help="parts of their names (default: all)"
    )
    return parser


def _setting(text: str) -> tuple[str, object]:
    name, equals, value = text.partition("=")
    if not (name.isidentifier() and equals):
        raise argparse.ArgumentTypeError(f"{text} is not of the form NAME=VALUE")
    try:
        return name, ast.literal_eval({"true": "True", "false": "False"}.get(value, value))
    except (ValueError, SyntaxError):
        return name, value


def _project() -> Path:
    """Folder of the project: this one or one above it."""
    project = _project_above()
    if project is None:
        raise PipelineError(
            "there is no notebooks/profiles.toml here or above: say this in a checkout of the "
            "project, which holds the notebooks and more than the installed package"
        )
    return project


def _project_above() -> Path | None:
    here = Path.cwd()
    for folder in (here, *here.parents):
        if (folder / "notebooks" / "profiles.toml").is_file():
            return folder
    return None


def _line(result: NotebookResult) -> str:
    if result.status == "done":
        return f"{result.name}: done in {result.seconds:.1f} s, {len(result.files)} files"
    if result.status == "failed":
        return f"{result.name}: FAILED after {result.seconds:.1f} s"
    return f"{result.name}: fresh"


def _summary(failed: Sequence[NotebookResult], count: int) -> str:
    parts = [f"\n{len(failed)} of {count} notebooks failed; their earlier results are untouched."]
    for result in failed:
        parts.append(f"\n{'-' * 80}\n{result.name}, {result.failure}")
        parts.append(f"executed copy: {_short(result.executed)}")
    return "\n".join(parts)


def _short(path: Path) -> str:
    """`path` as seen from here, where it is below."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


if __name__ == "__main__":
    sys.exit(main())
