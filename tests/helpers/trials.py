"""Trials of an attack, one after another in a process of its own that may hang or die."""

import argparse
import dis
import multiprocessing
import os
import resource
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import robsmooth

HOME = str(Path(robsmooth.__file__).parent)
LONGEST = 600  # characters of a sentence
SECONDS = 60.0  # without an answer: the process hangs
MEMORY = 1 << 30  # bytes more than at the start
Trial = Callable[[int, int], tuple[str, str | None]]  # of seed and number: outcome, and a failure


def is_own(error: BaseException) -> bool:
    """Return whether a `raise` statement of the package raised an error."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None or not last.tb_frame.f_code.co_filename.startswith(HOME):
        return False
    return dis.opname[last.tb_frame.f_code.co_code[last.tb_lasti]] == "RAISE_VARARGS"


def fault_of(error: Exception) -> str | None:
    """Return what is wrong with an error, if anything: it must be ours, and one sentence."""
    text = str(error)
    what = f"{type(error).__name__}: {text[:200]!r}"
    if not is_own(error):
        return f"raw {what}"
    if not text.strip() or "\n" in text or len(text) > LONGEST:
        return f"no sentence: {what}, {len(text)} characters"
    return None


def in_process(trial: Trial, tries: int, seed: int, first: int = 0) -> tuple[Counter, list[str]]:
    """Run trials here; return the outcomes' numbers and the failures."""
    outcomes, failures = Counter(), []
    for number in range(first, first + tries):
        outcome, failure = trial(seed, number)
        outcomes[outcome] += 1
        if failure is not None:
            failures.append(f"trial {number}: {failure}")
    return outcomes, failures


def _serve(trial: Trial, seed: int, numbers: range, answers) -> None:
    os.chdir(tempfile.mkdtemp(prefix="trials-"))  # where relative paths lead
    trial(seed, -1)  # what is compiled and kept
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    limit = 1024 * int(fields["VmData"].split()[0]) + MEMORY
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    answers.send("ready")
    for number in numbers:
        answers.send(trial(seed, number))


def apart(trial: Trial, tries: int, seed: int) -> tuple[Counter, list[str]]:
    """Run trials in processes that are limited in memory and replaced when they hang or die."""
    outcomes, failures, number = Counter(), [], 0
    context = multiprocessing.get_context("spawn")
    while number < tries:
        ours, theirs = context.Pipe(duplex=False)
        given = trial, seed, range(number, tries), theirs
        process = context.Process(target=_serve, args=given)
        process.start()
        theirs.close()
        try:
            if not ours.poll(20 * SECONDS) or ours.recv() != "ready":
                raise RuntimeError("the attack cannot begin")
        except EOFError:
            raise RuntimeError("the attack cannot begin: what is typical fails") from None
        try:
            while number < tries:
                if not ours.poll(SECONDS):
                    raise EOFError(f"no answer in {SECONDS:g} s")
                outcome, failure = ours.recv()
                outcomes[outcome] += 1
                if failure is not None:
                    failures.append(f"trial {number}: {failure}")
                    print(failures[-1], flush=True)
                number += 1
        except EOFError as error:
            outcomes["dead"] += 1
            failures.append(f"trial {number}: {error or 'the process died'}")
            print(failures[-1], flush=True)
            number += 1
        finally:
            process.kill()
            process.join()
    return outcomes, failures


def report(what: str, trial: Trial, tries: int, seed: int) -> bool:
    """Run trials apart, print what was found, and return whether any has failed."""
    outcomes, failures = apart(trial, tries, seed)
    counts = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.most_common())
    print(f"{what}: {tries} tries, {len(failures)} failures ({counts})", flush=True)
    return bool(failures)


def main(what: str, trial: Trial, tries: int) -> None:
    """Attack from the command line; exit with 1 where anything has failed."""
    parser = argparse.ArgumentParser(description=what)
    parser.add_argument("--tries", type=int, default=tries)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    sys.exit(report(what, trial, given.tries, given.seed))
