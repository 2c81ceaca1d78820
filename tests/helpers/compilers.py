"""C code, compiled by the system's compiler as strictly as it can be."""

import shutil
import subprocess

import pytest

STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic")


def compile_c(source, target, *flags, compiler="cc"):
    """Compile a file to a target; skip the test where there is no compiler."""
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no compiler {compiler}")
    command = [compiler, *flags, str(source), "-o", str(target), "-lm"]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    return target


def checked_by_its_record(source, record=None, *flags):
    """Return what the program in a file of `to_c` prints for a record, by default that beside it.

    That is the largest difference to the estimates in the record, of the largest estimate.
    """
    program = compile_c(source, source.with_suffix(""), *STRICT, "-DROBSMOOTH_TEST", *flags)
    command = [str(program), str(record or source.with_suffix(".csv"))]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
