"""Find a chromium to drive; as a script, install Debian's where there is none."""

import contextlib
import os
import shutil
import subprocess
import sys

NAMES = ("chromium", "chromium-browser", "google-chrome")


class NoChromium(LookupError):
    """There is no chromium; the message says what to do."""


def find() -> str:
    """Path of the browser that CHROMIUM names, or else of the first that there is."""
    named = os.environ.get("CHROMIUM")
    for name in [named] if named else NAMES:
        if path := shutil.which(name):
            return path
    if named:
        raise NoChromium(f"CHROMIUM={named} is no program that can be run")
    raise NoChromium(
        "there is no chromium to test with: make test-browser installs it, or as root"
        " apt-get install chromium, or name one with CHROMIUM=/path/to/it"
    )


def install() -> None:
    """Install Debian's chromium; where that cannot be done, leave things as they are."""
    apt = [*([] if os.geteuid() == 0 else ["sudo", "-n"]), "apt-get", "--quiet", "--yes"]
    # of what it recommends: fonts, without which pages show boxes, and what keeps pages apart
    packages = ["chromium", "chromium-sandbox", "fonts-liberation"]
    for command in (["update"], ["install", "--no-install-recommends", *packages]):
        with contextlib.suppress(FileNotFoundError):
            subprocess.run([*apt, *command], stdin=subprocess.DEVNULL)


def main() -> None:
    """Make sure that there is a chromium, or exit with a sentence."""
    try:
        find()
    except NoChromium:
        if not os.environ.get("CHROMIUM"):
            install()
    try:
        print(f"the browser is {find()}")
    except NoChromium as missing:
        sys.exit(str(missing))


if __name__ == "__main__":
    main()
