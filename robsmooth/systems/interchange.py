"""What a system is made of, read from python-control's objects."""

import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robsmooth._support import validation
from robsmooth._support.validation import Matrix
from robsmooth.systems.channels import Nonlinearity, Uncertainty
from robsmooth.systems.statespace import Blocks

if TYPE_CHECKING:
    import control

_ASYMMETRY = 1e-12  # of a covariance, and below zero of its eigenvalues, relative to its diagonal


def parts_of_statespace(
    sys: "control.StateSpace",
    lipschitz: ArrayLike,
    functions: Sequence[Callable[[Any], Any] | None] | None,
    references: Sequence[str | None] | None,
) -> dict[str, Any]:
    """Return the parts of a system as `UncertainSystem.from_statespace` reads it."""
    blocks = Blocks.of("sys", sys)
    k = _check_signals(blocks)
    mu, nu, D = blocks.into_state("mu"), blocks.from_state("nu"), blocks.direct("y", "mu")
    constants = validation.array("lipschitz", lipschitz, ndim=1)
    functions = [None] * len(constants) if functions is None else functions
    references = [None] * len(constants) if references is None else references
    validation.instance("functions", functions, Sequence)
    validation.instance("references", references, Sequence)
    for name, given in (
        ("sys's output 'nu'", nu),
        ("lipschitz", constants),
        ("functions", functions),
        ("references", references),
    ):
        if len(given) != mu.shape[1]:
            raise ValueError(
                f"{name} must have as many entries as sys's input 'mu', {mu.shape[1]}, "
                f"got {len(given)}"
            )
    return {
        "A": blocks.A,
        "B1": blocks.into_state("W"),
        "C0": blocks.from_state("w"),
        "C2": blocks.from_state("y"),
        "D21": blocks.direct("y", "W"),
        "uncertainties": [
            Uncertainty(
                blocks.into_state(f"xi_{s}"),
                blocks.from_state(f"zeta_{s}"),
                blocks.direct("y", f"xi_{s}"),
            )
            for s in range(k)
        ],
        "nonlinearities": [
            Nonlinearity(mu[:, [i]], nu[[i]], D[:, [i]], *of_function)
            for i, of_function in enumerate(zip(constants, functions, references, strict=True))
        ],
    }


def noise_factor(name: str, intensity: ArrayLike, size: int) -> Matrix:
    """Return the symmetric square root of a noise's intensity."""
    if np.ndim(intensity) == 0:
        return np.sqrt(validation.real(name, intensity, low=0.0)) * np.eye(size)
    intensity = validation.matrix(name, intensity, (size, size))
    if (np.diag(intensity) < 0.0).any():
        raise ValueError(f"{name} must not be negative on its diagonal")
    deviation = np.sqrt(np.diag(intensity))
    unit = np.where(deviation > 0.0, deviation, 1.0)
    correlation = intensity / np.outer(unit, unit)  # signals may have very different units
    if np.abs(correlation - correlation.T).max(initial=0.0) > _ASYMMETRY:
        raise ValueError(f"{name} must be symmetric")
    eigenvalues, vectors = np.linalg.eigh(correlation)
    if eigenvalues.min(initial=0.0) < -_ASYMMETRY:
        raise ValueError(
            f"{name} must be nonnegative definite, got one whose correlation matrix has the "
            f"eigenvalue {eigenvalues.min():.3g}"
        )
    root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0)) @ vectors.T
    return unit[:, None] * root


def _check_signals(blocks: Blocks) -> int:
    """Check that a system's signals are those of the class; return its number of uncertainties."""
    found = set()
    for kind, signals, known, channel in (
        ("input", blocks.inputs, ("W", "mu"), "xi"),
        ("output", blocks.outputs, ("w", "y", "nu"), "zeta"),
    ):
        for name in signals:
            of_channel = re.fullmatch(rf"{channel}_(\d+)", name)
            if of_channel:
                found.add(int(of_channel[1]))
            elif name not in known:
                raise ValueError(
                    f"sys's {kind} {name!r} must be one of {', '.join(known)}, {channel}_0, "
                    f"{channel}_1, ...; for a plant that is not so named there is from_plant"
                )
    for name in ("w", "y"):
        if name not in blocks.outputs:
            raise ValueError(f"sys must have an output {name!r}, got {', '.join(blocks.outputs)}")
    missing = set(range(len(found))) - found
    if missing:
        raise ValueError(
            f"sys must have its uncertainties numbered from 0, got xi_{max(found)} or "
            f"zeta_{max(found)} without xi_{min(missing)} and zeta_{min(missing)}"
        )
    for (output, name), D in blocks.feedthrough.items():
        if output != "y" and D.any():
            raise ValueError(f"sys must have feedthrough to 'y' only, got {name!r} to {output!r}")
    return len(found)
