"""The machine and what was measured on it, by name."""

import re

from llvmlite import binding
from numba import config
from threadpoolctl import threadpool_info

SETS = ("avx512f", "avx2", "avx", "sse4.2", "sve", "neon")  # the first that there is, is named
FOR_AVX2 = ", for AVX2"  # behind the names of those that a wider machine has compiled for it


def widest() -> str:
    """Return the widest vector instructions that this machine has."""
    features = binding.get_host_cpu_features()
    return next((name for name in SETS if features.get(name)), "scalar")


def instruction_set() -> str:
    """Return the widest vector instructions that compiled code may use."""
    found = widest()
    named = f"{found.removesuffix('f').upper()}, {binding.get_host_cpu_name()}"
    return f"{named}, compiled for {config.CPU_NAME}" if config.CPU_NAME else named


def blas() -> str:
    """Return the BLAS libraries of this process, and their threads before robsmooth sets one."""
    found = {
        f"{pool['internal_api']} {pool['version']} ({pool['num_threads']} threads)"
        for pool in threadpool_info()
        if pool["user_api"] == "blas"
    }
    return " and ".join(sorted(found)) or "none known"


def slug(machine: dict) -> str:
    """Return a file's name for results of machines of a kind."""
    named = f"{machine['processor']} {machine['instructions']} {machine['cores']} cores"
    return re.sub(r"[^a-z0-9]+", "-", named.lower()).strip("-")
