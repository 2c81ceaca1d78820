"""The C that `to_c` writes, compiled, and run over a whole record by a loop of C."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-lm")
DRIVER = """
#include "linear.h"
#include "copied.h"

void run_linear(long rows, const double *y, double *estimates)
{
    linear_state s;
    double filtered;
    linear_init(&s);
    for (long k = 0; k < rows; k++)
        linear_step(&s, y + k, estimates + k, &filtered);
}

void run_copied(long rows, const double *y, double *estimates)
{
    copied_state s;
    double filtered, reference = 0;
    copied_init(&s);
    for (long k = 0; k < rows; k++)
        copied_step(&s, y + k, &reference, estimates + k, &filtered);
}

void run_matrices(long rows, const double *y, double *estimates, int n, const double *A,
    const double *B, const double *C)
{
    double x[2][32] = {{0}};
    for (long k = 0; k < rows; k++) {
        const double *now = x[k % 2];
        double *next = x[(k + 1) % 2];
        estimates[k] = 0;
        for (int i = 0; i < n; i++) {
            next[i] = B[i] * y[k];
            for (int j = 0; j < n; j++)
                next[i] += A[i * n + j] * now[j];
            estimates[k] += C[i] * next[i];
        }
    }
}
"""


def compiled(linear, copied, parameters) -> ctypes.CDLL | None:
    """Write and compile two discrete smoothers of the example; None where there is no compiler.

    Parameters
    ----------
    linear, copied : DiscreteSmoother
        Without copies, and with a copy of the example's nonlinearity.
    parameters : HomodyneParameters
    """
    if shutil.which("cc") is None:
        return None
    size, slope = 2 * parameters.alpha, parameters.beta
    scale = size * parameters.gamma
    psi = f"{size!r} * (sin(x / {scale!r}) - {slope!r} * x / {scale!r})"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sources = [folder / f"{part}.c" for part in ("driver", "linear", "copied")]
        sources[0].write_text(DRIVER)
        linear.to_c(sources[1])
        copied.to_c(sources[2], [psi])
        target = folder / "steps.so"
        subprocess.run(["cc", *sources, *FLAGS, "-o", target], check=True)
        return ctypes.CDLL(str(target))


def looped(function, *more) -> Callable:
    """Return a function of a record (N, 1) that calls one of `DRIVER`; it returns estimates."""
    import numpy as np

    def run(y):
        estimates = np.empty_like(y)
        pointers = (each.ctypes.data_as(ctypes.c_void_p) for each in (y, estimates))
        function(ctypes.c_long(len(y)), *pointers, *more)
        return estimates

    return run
