"""The `robsmooth` command."""

import argparse
import ast
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import fields
from pathlib import Path

import robsmooth
from robsmooth._support import validation
from robsmooth._support.extras import MissingExtraError
from robsmooth.workbench.parameters import PipelineError
from robsmooth.workbench.runner import PROFILES, Request, plan, run_notebooks


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 after a failure, 2 for a wrong request."""
    _handle(signal.default_int_handler)
    try:
        options = _parser().parse_args(arguments)
        return options.command(options)
    except (PipelineError, MissingExtraError, OSError) as error:
        print(f"robsmooth: {validation.line(error, 600)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        _handle(signal.SIG_IGN)
        kept = "notebooks that had finished are kept, the results of the others are as they were"
        with suppress(OSError):  # of a terminal that is lost
            print(f"robsmooth: interrupted; {kept}", file=sys.stderr)
        return 130  # a shell's code for it


def figures(options: argparse.Namespace) -> int:
    """Run the notebooks, and write the report of the reproduction."""
    given = vars(options) | {"root": _project(), "parameters": dict(options.set)}
    given["only"] = [name for name in options.only.split(",") if name]
    run = Request(**{each.name: given[each.name] for each in fields(Request)})
    tasks, results, signals = plan(run), [], []
    _handle(lambda number, _: signals.append(number))  # for the run to end undisturbed
    with closing(run_notebooks(run, tasks, signals)) as running:
        for result in running:
            results.append(result)
            text = {"failed": f"FAILED after {result.seconds:.1f} s", "fresh": "fresh"}
            text["done"] = f"done in {result.seconds:.1f} s, {len(result.files)} files"
            print(f"{result.task.name}: {text[result.status]}", flush=True)
    _handle(signal.default_int_handler)
    if signals:
        raise KeyboardInterrupt
    failed = [result for result in results if result.failure]
    for result in sorted(failed, key=lambda result: result.task.name):
        print(f"\n{'-' * 80}\n{result.task.name}, {result.failure}", file=sys.stderr)
        print(f"executed copy: {result.task.executed}", file=sys.stderr)
    if not run.parameters and len(failed) < len(results):
        _write_report(run)
    if failed:
        count = f"{len(failed)} of {len(results)} notebooks failed"
        print(f"\n{count}; their earlier results are untouched.", file=sys.stderr)
        return 1
    print(f"figures and tables are in {run.results / 'figures'}")
    return 0


def _handle(handler: Callable | signal.Handlers) -> None:
    """Let a handler have the signals that end the command, unless they are ignored."""
    for name in {"SIGINT", "SIGTERM", "SIGHUP"} & vars(signal).keys():  # Windows has not the last
        if signal.getsignal(getattr(signal, name)) != signal.SIG_IGN:
            signal.signal(getattr(signal, name), handler)


def _write_report(run: Request) -> None:
    from robsmooth.paper import report

    if not (run.results / "data/monte_carlo.json").exists():
        print("no report yet: it needs the results of 04_nonlinear_monte_carlo")
        return
    verdicts = report.write(run.results / "figures", run.results / "data")
    if run.results == run.root:
        report.write_scorecard(run.root / "README.md", verdicts)


def verdicts(options: argparse.Namespace) -> int:
    """Print every printed number of the paper with its verdict."""
    from robsmooth.paper import report
    from robsmooth.paper import verdicts as paper_verdicts

    try:
        print(report.markdown(paper_verdicts.verdicts()))
    except ValueError as error:  # no Monte Carlo results, or damaged ones
        raise PipelineError(str(error)) from error
    return 0


def bench(options: argparse.Namespace) -> int:
    """Measure the speed of the simulation and of its peers, by benchmarks/."""
    command = [sys.executable, "-m", "benchmarks", *(["--write"] if options.write else [])]
    return subprocess.run(command, cwd=_project()).returncode


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="robsmooth", description=__doc__)
    version = f"robsmooth {robsmooth.__version__}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    add = _command(commands, "figures", figures, "run the notebooks that are not fresh")
    text = "scale of the run (default: %(default)s); quick writes to build/quick"
    add("--profile", choices=PROFILES, default=Request.profile, help=text)
    add("--only", metavar="NAME,...", default="", help="parts of notebooks' names (default: all)")
    text = "set a parameter to a value of your own; the results go to build/custom"
    add("--set", metavar="NAME=VALUE", type=_setting, action="append", default=[], help=text)
    add("--jobs", type=int, default=Request.jobs, help="notebooks at a time (default: %(default)s)")
    text = "for a notebook; a cell may take half as long (default: %(default)g)"
    add("--time-limit", metavar="SECONDS", type=float, default=Request.time_limit, help=text)
    add("--force", action="store_true", help="also run the fresh notebooks")
    text = "compute on the cluster of the Dask scheduler at tls://host:port (tcp:// if it is here)"
    add("--dask", metavar="ADDRESS", default=Request.dask, help=text)
    add("--allow-insecure", action="store_true", help="let --dask be off this machine without TLS")
    add("--build", metavar="FOLDER", type=Path, help="folder to work in (default: build)")

    _command(commands, "verdicts", verdicts, "every printed number with its verdict")

    add = _command(commands, "bench", bench, "measure the speed of the simulation")
    add("--write", action="store_true", help="write benchmarks/results.* and the README's block")
    return parser


def _command(commands, name: str, function: Callable, text: str) -> Callable:
    command = commands.add_parser(name, help=text)
    command.set_defaults(command=function)
    return command.add_argument


def _setting(text: str) -> tuple[str, object]:
    name, equals, value = text.partition("=")
    if not (name.isidentifier() and equals):
        raise argparse.ArgumentTypeError(f"{text[:60]} is not of the form NAME=VALUE")
    try:
        return name, ast.literal_eval({"true": "True", "false": "False"}.get(value, value))
    except Exception:  # not Python, or too deep
        return name, value


def _project() -> Path:
    for folder in (Path.cwd(), *Path.cwd().parents):
        if (folder / "notebooks/profiles.toml").is_file():
            return folder
    raise PipelineError(
        "there is no notebooks/profiles.toml here or above: run this command in a checkout of the "
        "project; the installed package has no notebooks"
    )
