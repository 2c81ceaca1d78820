"""Cycle slips, sines and noise, for the kernels of both protocols.

Each path has a xoshiro128+ generator, seeded by (seed, path index), and Box and Muller's normal
variables (`docs/source/simulation.md`). Logarithm, sine and cosine are minimax polynomials, as no
library has them for vectors. With integer operations, explicit fused multiply-adds, products and
square roots only, the results have the same bits on every machine that has these.
"""

import hashlib
import math
from pathlib import Path

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from robsmooth._numerics import vectors
from robsmooth._numerics.vectors import BLOCK, LANES, fma, load, polynomial, root, store, view

CACHE_LINE = 64  # bytes
WORDS = 4  # 32-bit words of a generator's state
DRAWS = 2  # Gaussians a step
STATE = (np.uint32(0),) * WORDS
GENERATOR = "xoshiro128+ seeded by splitmix64(seed, path), Box-Muller in float32"

TURN = 2 * np.pi
SLIP = 0.75 * TURN  # from the lock point; half a turn would count a single passage several times

# A default argument of each kernel: it is compiled anew when these modules change. Numba itself
# looks only at the kernel's own file.
_FILES = (Path(__file__), Path(vectors.__file__))
SOURCES = hashlib.sha256(b"".join(file.read_bytes() for file in _FILES)).hexdigest()

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)
MANTISSA, SIGN, BITS_OF_3 = 2**23 - 1, 2**31, 0x40400000

MINUS_TWO_LN_2 = -2 * math.log(2)
SQRT_HALF_BITS = np.int32(np.float32(math.sqrt(0.5)).view(np.int32))
SQRT_HALF_BITS_31 = np.int32(SQRT_HALF_BITS + (31 << 23))

SINE_FLOAT32 = (-0.166666571, 0.00833301729, -0.000198066152, 2.60005475e-06)
SINE_FLOAT64 = (
    -0.16666666606466835,
    0.008333330495666445,
    -0.00019840804038674084,
    2.7522618831355344e-06,
    -2.384669365464371e-08,
)

COSINE_FLOAT32 = (1.0, -0.499999323, 0.0416639895, -0.00138559272, 2.31943864e-05)
# By powers of the square of an angle in quarter turns: sine over angle, and cosine.
SINE = tuple(c * (math.pi / 2) ** (2 * k + 1) for k, c in enumerate((1.0, *SINE_FLOAT32)))
COSINE = tuple(c * (math.pi / 2) ** (2 * k) for k, c in enumerate(COSINE_FLOAT32))
LOG = (1.00000576, 0.666701821, 0.49946771, 0.397879914, 0.344031173, 0.325579819, 0.206959919)


@intrinsic
def slip(typingctx, away):
    """By how many turns, 0 or +-1, paths have slipped that are `away` from their lock points."""

    def codegen(context, builder, signature, arguments):
        kind = arguments[0].type
        forward, back = (
            builder.uitofp(builder.fcmp_ordered(than, arguments[0], ir.Constant(kind, limit)), kind)
            for than, limit in ((">", SLIP), ("<", -SLIP))
        )
        return builder.fsub(forward, back)

    return away(away), codegen


@njit(inline="always")
def count_slips(lock, start, result):
    """Count the slips of paths at these distances from zero, in the rows of slips and of turns."""
    slips, turns = load(result, start, (0.0, 0.0))
    passed = slip(lock - turns)
    store(result, start, (fma(passed, passed, slips), fma(passed, TURN, turns)))


def multiple(builder, x, period, mantissa):
    r"""Return code for the integer nearest to x / period, in the lowest bits, and as a float.

    Adding :math:`1.5\cdot 2^m`, with m bits of mantissa, rounds to an integer.
    """
    shifter = ir.Constant(x.type, 1.5 * 2**mantissa)
    shifted = vectors.call(builder, "fma", x, ir.Constant(x.type, 1 / period), shifter)
    return shifted, builder.fsub(shifted, shifter)


@intrinsic
def sine(typingctx, x):
    r"""The sine of a float32 or float64, to 2e-11 or float32 rounding, for ``|x|`` below 1e5.

    :math:`\sin x = (-1)^k \sin(x - k\pi)` with :math:`k` the integer nearest to :math:`x/\pi`, and
    an odd polynomial of degree 9 or 11 on :math:`[-\pi/2, \pi/2]`.
    """
    single = getattr(x, "dtype", x) == types.float32
    coefficients, width = (SINE_FLOAT32, 32) if single else (SINE_FLOAT64, 64)
    mantissa = 23 if single else 52

    def codegen(context, builder, signature, arguments):
        (x,) = arguments
        kind = x.type
        word = ir.IntType(width)
        if isinstance(kind, ir.VectorType):
            word = ir.VectorType(word, kind.count)
        shifted, k = multiple(builder, x, math.pi, mantissa)
        rest = vectors.call(builder, "fma", k, ir.Constant(kind, -math.pi), x)
        square = builder.fmul(rest, rest)
        tail = ir.Constant(kind, coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            tail = vectors.call(builder, "fma", tail, square, ir.Constant(kind, coefficient))
        result = vectors.call(builder, "fma", builder.fmul(rest, square), tail, rest)
        odd = builder.shl(builder.bitcast(shifted, word), ir.Constant(word, width - 1))
        return builder.bitcast(builder.xor(builder.bitcast(result, word), odd), kind)

    return x(x), codegen


@intrinsic
def whole_turns(typingctx, x):
    r"""The multiple of :math:`2\pi` nearest to a float32 or float64 below 1e5."""

    def codegen(context, builder, signature, arguments):
        mantissa = 23 if getattr(x, "dtype", x) == types.float32 else 52
        _, k = multiple(builder, arguments[0], 2 * math.pi, mantissa)
        return builder.fmul(k, ir.Constant(k.type, 2 * math.pi))

    return x(x), codegen


@njit(inline="always")
def minus_two_log(v):
    """-2 log(v / 2^31) of a float32 v between 1/2 and 2^31, to a relative 3e-7."""
    bits = view(v, np.int32) - SQRT_HALF_BITS_31  # 31 less in the exponent
    exponent = vectors.converted(bits >> 23, np.float32)
    f = 1.0 - view((bits & MANTISSA) + SQRT_HALF_BITS, np.float32)  # 1 - sqrt(2) to 1 - sqrt(1/2)
    series = fma(f * f, polynomial(f, LOG), f + f)
    return fma(exponent, MINUS_TWO_LN_2, series)


@njit(inline="always")
def sin_quarter(angle):
    """Sine of a float32 angle, in quarter turns, in [-1, 1], to 1.5e-7."""
    return angle * polynomial(angle * angle, SINE)


@njit(inline="always")
def cos_quarter(angle):
    """Cosine of a float32 angle, in quarter turns, in [-1, 1], to 1.5e-7."""
    return polynomial(angle * angle, COSINE)


@njit
def mix(z):
    """Output function of splitmix64, a bijection of 64-bit words."""
    z = (z ^ (z >> np.uint64(30))) * MIX_1
    z = (z ^ (z >> np.uint64(27))) * MIX_2
    return z ^ (z >> np.uint64(31))


@njit
def aligned(size, dtype):
    """Return zeros of this type whose vectors do not lie across cache lines."""
    room = np.zeros(size + CACHE_LINE, dtype)
    start = -room.ctypes.data % CACHE_LINE // room.itemsize
    return room[start : start + size]


@njit
def seed_paths(seed, first_path, generator):
    """Start the generators of BLOCK paths: word w of path i, a uint32, at ``w * BLOCK + i``."""
    for i in range(BLOCK):
        path = first_path + np.uint64(i)
        state = mix(mix(seed + GOLDEN) + path * GOLDEN)
        for half in range(WORDS // 2):
            state += GOLDEN
            word = mix(state)
            generator[2 * half * BLOCK + i] = np.uint32(word >> np.uint64(32))
            generator[(2 * half + 1) * BLOCK + i] = np.uint32(word)


@njit(inline="always")
def next_word(state):
    """A word of xoshiro128+, and its state after that."""
    s0, s1, s2, s3 = state
    t = s2 ^ s0
    u = s3 ^ s1
    return s0 + s3, (s0 ^ u, s1 ^ t, t ^ (s1 << 9), (u << 11) | (u >> 21))


@njit(inline="always")
def two_gaussians(a, b):
    """Two independent standard normal variables, float32, from two words."""
    radius = root(minus_two_log(vectors.converted(view(a >> 1, np.int32), np.float32) + 0.5))
    # The low bits of b are the mantissa of a number in [2, 4).
    angle = view(((b >> 8) & MANTISSA) ^ BITS_OF_3, np.float32) - 3.0  # in quarter turns
    cosine = view(view(cos_quarter(angle), np.uint32) ^ (b & SIGN), np.float32)
    return radius * cosine, radius * sin_quarter(angle)


@njit
def fill_gaussians(generator, steps, noise):
    """Draw the float32 noise: draw d of step k of path i at ``(k * DRAWS + d) * BLOCK + i``."""
    for path in range(0, BLOCK, LANES):
        state = load(generator, path, STATE)
        for step in range(steps):
            a, state = next_word(state)
            b, state = next_word(state)
            store(noise, step * DRAWS * BLOCK + path, two_gaussians(a, b))
        store(generator, path, state)
