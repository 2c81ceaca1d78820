"""What the attacks of tests/attacks share: counts of tries and failures, and the command line."""

import argparse
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field


@dataclass
class Attack:
    """The tries of one attack, with how often each failure came."""

    name: str
    tries: int = 0
    failures: Counter = field(default_factory=Counter)
    slowest: float = 0.0  # s, of the answers, where these are timed
    answers: Counter = field(default_factory=Counter)  # where more than one is right

    def add(self, failure: str | None) -> None:
        """Count a try, which failed where there is a sentence."""
        self.tries += 1
        if failure:
            self.failures[failure] += 1

    def __str__(self) -> str:
        slowest = f", slowest answer {self.slowest:.2f} s" if self.slowest else ""
        first = f"{self.name}: {self.tries} tries, {self.failures.total()} failures{slowest}"
        several = [*self.failures.items(), *self.answers.items()]
        return "\n".join([first, *(f"    {count} x {each}" for each, count in several)])


def command(text: str, names: Iterable[str], attack: Callable, tries: int = 20) -> None:
    """Make each attack, by ``attack(name, tries, draw)``; exit with 1 where one failed."""
    parser = argparse.ArgumentParser(description=text)
    parser.add_argument("--tries", type=int, default=tries, help="of each (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the random moments")
    parser.add_argument("--only", default="", help="a part of the names of attacks to make")
    asked = parser.parse_args()
    failed = 0
    for name in names:
        if asked.only in name:
            found = attack(name, asked.tries, random.Random(f"{asked.seed} {name}"))
            print(found, flush=True)
            failed += found.failures.total()
    sys.exit(failed > 0)
