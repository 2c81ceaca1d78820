"""Build the site and say where it is."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from docs.build import build
from robsmooth.workbench.parameters import PipelineError
from robsmooth.workbench.runner import PROFILES

ROOT = Path(__file__).resolve().parent.parent


def main(arguments: Sequence[str] | None = None) -> int:
    """Build; return 0, 1 where Sphinx has warned, 2 where something is missing."""
    parser = argparse.ArgumentParser(prog="python -m docs", description=__doc__)
    parser.add_argument("--profile", choices=PROFILES, default="paper", help="whose results")
    parser.add_argument("--build", type=Path, help="folder that the run has worked in")
    options = parser.parse_args(arguments)
    try:
        site = build(ROOT, options.profile, options.build and options.build.resolve())
    except PipelineError as error:
        print(f"robsmooth: {error}", file=sys.stderr)
        return 2
    if site is None:
        print("robsmooth: no new site was made; the warnings above say why", file=sys.stderr)
        return 1
    if site.is_relative_to(Path.cwd()):
        site = site.relative_to(Path.cwd())
    print(f"open {site / 'index.html'} in a browser; it needs no network")
    return 0


if __name__ == "__main__":
    sys.exit(main())
