"""Ways to simulate the literal protocol, each with noise of its natural kind.

Every module has a tuple ``PEERS``. What a module needs and this machine may not have, it looks for
in `prepare` only.
"""

from benchmarks.peers import (
    cpp,
    diffrax_euler,
    jax_scan,
    numba_scalar,
    numpy_vectorised,
    octave,
    python_loop,
    robsmooth_kernel,
)
from benchmarks.problem import Peer

# Those that are nearly as fast as each other are measured one after the other.
PEERS: tuple[Peer, ...] = tuple(
    peer for pair in zip(robsmooth_kernel.PEERS, cpp.PEERS, strict=True) for peer in pair
) + tuple(
    peer
    for module in (
        numpy_vectorised,
        jax_scan,
        diffrax_euler,
        numba_scalar,
        python_loop,
        octave,
    )
    for peer in module.PEERS
)
