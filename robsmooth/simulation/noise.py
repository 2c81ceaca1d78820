r"""Cycle slips, sines and noise, for the kernels of both protocols.

Each path has a xoshiro128+ generator (D. Blackman and S. Vigna, ACM Trans. Math. Softw. 47(4),
2021). Its state is a splitmix64 hash of (seed, path index), so the noise depends on these two
numbers alone. A step turns two 32-bit words, a and b, into two independent standard normal
variables (G. E. P. Box and M. E. Muller, Ann. Math. Stat. 29(2), 1958),

.. math::

    g_1 = \pm R\cos\theta,\quad g_2 = R\sin\theta,\qquad
    R = \sqrt{-2\ln U},\quad U = 2^{-31}(\lfloor a/2\rfloor + 1/2),

where the top bit of :math:`b` is the sign and the other bits give :math:`\theta`, uniform in
:math:`[-\pi/2, \pi/2)`. The tails end at :math:`R = \sqrt{64\ln 2} = 6.66`.

The paths of a *block* are simulated side by side: a flat array has rows of `BLOCK` numbers, one for
each path, and the compiler turns the loops over paths into vector instructions. Logarithm, sine and
cosine are minimax polynomials, because calls of a library would prevent that. With integer
operations, explicit fused multiply-adds, products and square roots only, the results have the same
bits on every machine that has these.
"""

import hashlib
import math
from pathlib import Path

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

BLOCK = 128  # paths side by side: enough independent work to hide the latency of a step
WORDS = 4  # 32-bit words of a generator's state
DRAWS = 2  # Gaussians a step
GENERATOR = "xoshiro128+ seeded by splitmix64(seed, path), Box-Muller in float32"

TURN = 2 * np.pi
SLIP = 0.75 * TURN  # from the lock point; half a turn would count a single passage several times

# A default argument of each kernel: it is compiled anew when this module changes. Numba itself
# looks only at the kernel's own file.
SOURCES = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)
U1, U9, U11, U21 = (np.uint32(shift) for shift in (1, 9, 11, 21))

MINUS_TWO_LN_2 = -2 * math.log(2)
HALF_TURN_M32 = math.pi / 2**32
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


@njit
def slip(away):
    """Return by how many turns, 0 or +-1, a path has slipped that is `away` from its lock point."""
    return (1.0 if away > SLIP else 0.0) - (1.0 if away < -SLIP else 0.0)


@intrinsic
def fma(typingctx, a, b, c):
    """`a * b + c`, rounded once, in the precision of `a`."""

    def codegen(context, builder, signature, arguments):
        given = zip(arguments, signature.args, strict=True)
        return builder.fma(*(context.cast(builder, value, kind, a) for value, kind in given))

    return a(a, b, c), codegen


def multiple(builder, x, period, mantissa):
    r"""Return code for the integer nearest to x / period, in the lowest bits, and as a float.

    Adding :math:`1.5\cdot 2^m`, with m bits of mantissa, rounds to an integer.
    """
    shifter = ir.Constant(x.type, 1.5 * 2**mantissa)
    shifted = builder.fma(x, ir.Constant(x.type, 1 / period), shifter)
    return shifted, builder.fsub(shifted, shifter)


@intrinsic
def sine(typingctx, x):
    r"""The sine of a float32 or float64, to 2e-11 or float32 rounding, for ``|x|`` below 1e5.

    :math:`\sin x = (-1)^k \sin(x - k\pi)` with :math:`k` the integer nearest to :math:`x/\pi`, and
    an odd polynomial of degree 9 or 11 on :math:`[-\pi/2, \pi/2]`.
    """
    coefficients = SINE_FLOAT32 if x == types.float32 else SINE_FLOAT64
    width, mantissa = (32, 23) if x == types.float32 else (64, 52)

    def codegen(context, builder, signature, arguments):
        (x,) = arguments
        kind, word = x.type, ir.IntType(width)
        shifted, k = multiple(builder, x, math.pi, mantissa)
        rest = builder.fma(k, ir.Constant(kind, -math.pi), x)
        square = builder.fmul(rest, rest)
        tail = ir.Constant(kind, coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            tail = builder.fma(tail, square, ir.Constant(kind, coefficient))
        result = builder.fma(builder.fmul(rest, square), tail, rest)
        odd = builder.shl(builder.bitcast(shifted, word), ir.Constant(word, width - 1))
        return builder.bitcast(builder.xor(builder.bitcast(result, word), odd), kind)

    return x(x), codegen


@intrinsic
def whole_turns(typingctx, x):
    r"""The multiple of :math:`2\pi` nearest to a float32 or float64 below 1e5."""

    def codegen(context, builder, signature, arguments):
        mantissa = 23 if x == types.float32 else 52
        _, k = multiple(builder, arguments[0], 2 * math.pi, mantissa)
        return builder.fmul(k, ir.Constant(k.type, 2 * math.pi))

    return x(x), codegen


@njit
def minus_two_log(v):
    """-2 log(v / 2^31) of a float32 v between 1/2 and 2^31, to a relative 3e-7."""
    bits = np.int32(np.float32(v).view(np.int32) - SQRT_HALF_BITS_31)  # 31 less in the exponent
    exponent = np.int32(bits >> np.int32(23))
    mantissa = np.int32(np.int32(bits & np.int32(2**23 - 1)) + SQRT_HALF_BITS).view(np.float32)
    f = np.float32(1) - mantissa  # in (1 - sqrt(2), 1 - sqrt(1/2)]
    p = fma(f, 0.20695991919743753, 0.32557981860386714)
    p = fma(f, p, 0.3440311727098379)
    p = fma(f, p, 0.39787991415914753)
    p = fma(f, p, 0.4994677100123494)
    p = fma(f, p, 0.6667018213402259)
    p = fma(f, p, 1.000005755167118)
    return fma(np.float32(exponent), MINUS_TWO_LN_2, fma(f * f, p, np.float32(f + f)))


@njit
def flip_sign(value, bits):
    """A float32, negated where the top bit of the uint32 `bits` is set."""
    sign = np.uint32(bits & np.uint32(1 << 31))
    return np.uint32(np.float32(value).view(np.uint32) ^ sign).view(np.float32)


@njit
def sin_quarter(x):
    """Sine of a float32 in [-pi/2, pi/2], to 1e-7."""
    z = x * x
    p = fma(z, SINE_FLOAT32[3], SINE_FLOAT32[2])
    p = fma(z, p, SINE_FLOAT32[1])
    p = fma(z, p, SINE_FLOAT32[0])
    return fma(x * z, p, x)


@njit
def cos_quarter(x):
    """Cosine of a float32 in [-pi/2, pi/2], to 1.5e-7."""
    z = x * x
    p = fma(z, 2.3194386389259867e-05, -0.0013855927179344985)
    p = fma(z, p, 0.04166398945404269)
    p = fma(z, p, -0.4999993229301647)
    return fma(z, p, np.float32(1))


@njit
def mix(z):
    """Output function of splitmix64, a bijection of 64-bit words."""
    z = (z ^ (z >> np.uint64(30))) * MIX_1
    z = (z ^ (z >> np.uint64(27))) * MIX_2
    return z ^ (z >> np.uint64(31))


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
def next_word(s0, s1, s2, s3):
    """A word of xoshiro128+, and its state after that."""
    word = np.uint32(s0 + s3)
    t = np.uint32(s1 << U9)
    s2 = np.uint32(s2 ^ s0)
    s3 = np.uint32(s3 ^ s1)
    s1 = np.uint32(s1 ^ s2)
    s0 = np.uint32(s0 ^ s3)
    s2 = np.uint32(s2 ^ t)
    s3 = np.uint32(np.uint32(s3 << U11) | np.uint32(s3 >> U21))
    return word, s0, s1, s2, s3


@njit
def fill_gaussians(generator, steps, noise):
    """Draw the float32 noise: draw d of step k of path i at ``(k * DRAWS + d) * BLOCK + i``."""
    for step in range(steps):
        start = step * DRAWS * BLOCK
        for path in range(BLOCK):
            s0 = generator[path]
            s1 = generator[BLOCK + path]
            s2 = generator[2 * BLOCK + path]
            s3 = generator[3 * BLOCK + path]

            a, s0, s1, s2, s3 = next_word(s0, s1, s2, s3)
            b, s0, s1, s2, s3 = next_word(s0, s1, s2, s3)
            generator[path] = s0
            generator[BLOCK + path] = s1
            generator[2 * BLOCK + path] = s2
            generator[3 * BLOCK + path] = s3

            uniform = np.float32(np.float32(np.int32(a >> U1)) + np.float32(0.5))
            radius = np.sqrt(minus_two_log(uniform))
            angle = np.float32(np.int32(b << U1)) * np.float32(HALF_TURN_M32)
            noise[start + path] = radius * flip_sign(cos_quarter(angle), b)
            noise[start + BLOCK + path] = radius * sin_quarter(angle)
