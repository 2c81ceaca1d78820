"""Random stable uncertain systems, and designs for them, for the property tests.

Hypothesis draws sizes and a seed; the entries come from NumPy's generator, whose distributions are
those that the theory speaks of. Everything is of order one: invariances bring in the units.
"""

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from robsmooth import (
    InfeasibleDesignError,
    Nonlinearity,
    UncertainSystem,
    Uncertainty,
    augment,
    design_smoother,
)
from robsmooth.estimators.conditions import multiplier_level

seeds = st.integers(0, 2**32 - 1)


def stable_matrix(rng, n, margin=0.3):
    """A matrix whose spectrum lies at least `margin` left of the imaginary axis."""
    A = rng.standard_normal((n, n))
    return A - (np.linalg.eigvals(A).real.max() + margin + rng.exponential()) * np.eye(n)


def orthogonal_matrix(rng, n):
    return np.linalg.qr(rng.standard_normal((n, n)))[0]


def random_system(rng, n=2, m=1, measurements=1, g=1, size=0.1):
    """A system that satisfies Assumptions 1 and 2, with uncertainty of relative `size`.

    One uncertainty with two inputs carries the process noise (and some of the measurement's), one
    carries the measurement noise. The noises are the channels' own, mixed by a rotation.
    """
    r = 2
    B, D = rng.standard_normal((n, r)), 0.2 * rng.standard_normal((measurements, r))
    noise = np.diag(rng.uniform(0.3, 1.0, measurements))
    uncertainties = (
        Uncertainty(B, size * rng.standard_normal((3, n)), D),
        Uncertainty(np.zeros((n, measurements)), size * rng.standard_normal((1, n)), noise),
    )
    nonlinearities = tuple(
        Nonlinearity(
            rng.standard_normal((n, 1)),
            size * rng.standard_normal((1, n)),
            rng.standard_normal((measurements, 1)),
            lipschitz=rng.uniform(0.5, 2.0),
        )
        for _ in range(g)
    )
    mixing = orthogonal_matrix(rng, r + measurements)
    return UncertainSystem(
        A=stable_matrix(rng, n),
        B1=np.hstack([B, np.zeros((n, measurements))]) @ mixing,
        C0=rng.standard_normal((m, n)),
        C2=rng.standard_normal((measurements, n)),
        D21=np.hstack([D, noise]) @ mixing,
        uncertainties=uncertainties,
        nonlinearities=nonlinearities,
    )


def random_multipliers(rng, plant):
    """Multipliers on the boundary of the constraint, those of the copies' own not too small."""
    k, g = plant.system.k, plant.system.g
    multipliers = rng.uniform(0.3, 1.0, k + 3 * g)
    multipliers[k + g :] *= 0.3
    return multipliers / multiplier_level(plant, multipliers)


def feasible_design(rng, plant, cost="filtered"):
    """A design at random multipliers and about the least tau that is feasible, or None."""
    multipliers = random_multipliers(rng, plant)
    for tau in rng.uniform(1.0, 2.0) * np.geomspace(0.1, 1e4, 16):
        try:
            return design_smoother(plant, tau, multipliers, cost)
        except InfeasibleDesignError:
            continue
    return None


@st.composite
def systems(draw, max_g=2, max_size=0.15):
    """Systems of up to 3 states, 2 outputs, 2 measurements and `max_g` nonlinearities."""
    sizes = {
        name: draw(st.integers(1, top), label=name)
        for name, top in (("n", 3), ("m", 2), ("measurements", 2))
    }
    g = draw(st.integers(0, max_g), label="g")
    size = draw(st.just(0.0) | st.floats(1e-9, max_size), label="size")
    return random_system(np.random.default_rng(draw(seeds)), **sizes, g=g, size=size)


@st.composite
def plants(draw, max_g=2, max_order=3, max_size=0.15):
    """Augmented systems with a lag between 0 and 2 and a delay model of up to `max_order`."""
    system = draw(systems(max_g=max_g, max_size=max_size))
    delay = draw(st.just(0.0) | st.floats(0.05, 2.0), label="delay")
    return augment(system, delay, draw(st.integers(0, max_order), label="order"))


@st.composite
def designs(draw, cost="filtered", **kinds):
    """Feasible designs; a system for which none is found is left out."""
    plant = draw(plants(**kinds))
    design = feasible_design(np.random.default_rng(draw(seeds)), plant, cost)
    assume(design is not None)
    return design


def admissible_delta(rng, plant):
    """A random Delta that satisfies every constraint: (eqIQC1) to (eqIQC4), each by itself.

    Blocks of norm at most one for the uncertainties; for a nonlinearity, the same slope as its
    copy, at most its Lipschitz constant. Half of the draws are extreme.
    """
    system = plant.system
    extreme = rng.random() < 0.5
    blocks = []
    for channel in system.uncertainties:
        block = rng.standard_normal((channel.B.shape[1], channel.C.shape[0]))
        block /= np.linalg.norm(block, 2)
        blocks.append(block if extreme else rng.random() * block)
    slopes = [
        c.lipschitz * (rng.choice([-1.0, 1.0]) if extreme else rng.uniform(-1, 1))
        for c in system.nonlinearities
    ]
    return plant.structured_delta(blocks, slopes)
