// The literal protocol written by hand for one processor, as fast as we can make it.
//
// Paths lie side by side in vectors of the machine's width. A block of paths draws the noise of a few
// steps into the first-level cache, and then takes these steps with the state of `CHAINS` vectors at
// a time in registers: the steps of a path depend on each other, and this many independent chains
// keep the arithmetic units busy in the meantime. The noise is robsmooth's (xoshiro128+, Box-Muller,
// the same polynomials), so that the same paths come out, but for rounding.
//
// Floating multiplications are what there is most of. Hence the factor -2 of the logarithm and the
// pi/2 of the angle are in the polynomials' coefficients.

#include <cstdint>
#if defined(__AVX__)
#include <immintrin.h>
#endif

#ifndef ORDER
#define ORDER 3  // states of the estimator
#endif

#if defined(__AVX512F__)
constexpr int BYTES = 64, CHAINS = 3;
#elif defined(__AVX__)
constexpr int BYTES = 32, CHAINS = 3;
#else
constexpr int BYTES = 16, CHAINS = 3;
#endif
constexpr int VECTORS = CHAINS;  // of floats in a block
constexpr int WIDTH = BYTES / sizeof(float);
constexpr int LANES = VECTORS * WIDTH;  // paths in a block
constexpr int CHUNK = 32;  // steps for which noise is drawn ahead

typedef uint32_t Words __attribute__((vector_size(BYTES)));
typedef int32_t Integers __attribute__((vector_size(BYTES)));

#define INLINE static inline __attribute__((always_inline))

template <class Real>
struct Precision;

template <>
struct Precision<float> {
  typedef float Vector __attribute__((vector_size(BYTES)));
  typedef Vector Noise;
  typedef int32_t Bits __attribute__((vector_size(BYTES)));
  static constexpr float shifter = 0x1.8p23f;
  static constexpr int top = 31, terms = 4;
  static constexpr float sine[terms] = {
      2.600054754413543e-06f, -0.0001980661519421222f, 0.008333017291442748f, -0.166666570964985f};
};

template <>
struct Precision<double> {
  typedef double Vector __attribute__((vector_size(BYTES)));
  typedef float Noise __attribute__((vector_size(BYTES / 2)));
  typedef int64_t Bits __attribute__((vector_size(BYTES)));
  static constexpr double shifter = 0x1.8p52;
  static constexpr int top = 63, terms = 5;
  static constexpr double sine[terms] = {-2.384669365464371e-08, 2.7522618831355344e-06,
                                         -0.00019840804038674084, 0.008333330495666445,
                                         -0.16666666606466835};
};

typedef Precision<float>::Vector Floats;

// --- noise ---------------------------------------------------------------------------------------

struct Generator {
  Words s0, s1, s2, s3;
};

INLINE Words draw(Generator &g) {
  Words result = g.s0 + g.s3, t = g.s1 << 9;
  g.s2 ^= g.s0;
  g.s3 ^= g.s1;
  g.s1 ^= g.s2;
  g.s0 ^= g.s3;
  g.s2 ^= t;
  g.s3 = (g.s3 << 11) | (g.s3 >> 21);
  return result;
}

static uint64_t mix(uint64_t z) {
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return z ^ (z >> 31);
}

static Generator seeded(uint64_t seed, uint64_t first_path) {
  const uint64_t golden = 0x9E3779B97F4A7C15u;
  Generator g;
  for (int lane = 0; lane < WIDTH; lane++) {
    uint64_t state = mix(mix(seed + golden) + (first_path + lane) * golden);
    uint64_t first = mix(state + golden), second = mix(state + 2 * golden);
    g.s0[lane] = first >> 32;
    g.s1[lane] = first;
    g.s2[lane] = second >> 32;
    g.s3[lane] = second;
  }
  return g;
}

INLINE Floats square_root(Floats x) {
#if defined(__AVX512F__)
  return _mm512_sqrt_ps(x);
#elif defined(__AVX__)
  return _mm256_sqrt_ps(x);
#else
  for (int lane = 0; lane < WIDTH; lane++) x[lane] = __builtin_sqrtf(x[lane]);
  return x;
#endif
}

// The square root of -2 ln(v / 2^31). The 31 is in the offset of the exponent.
INLINE Floats radius(Floats v) {
  constexpr int32_t root_half = 0x3f3504f3, scale = 31 << 23;
  Integers bits = (Integers)v - (root_half + scale);
  Floats exponent = __builtin_convertvector(bits >> 23, Floats);
  Floats f = 1.0f - (Floats)((bits & 0x7fffff) + root_half);
  Floats p = f * (2 * 0.10347995959871877f) + 2 * 0.16278990930193357f;
  p = f * p + 2 * 0.17201558635491895f;
  p = f * p + 2 * 0.19893995707957376f;
  p = f * p + 2 * 0.2497338550061747f;
  p = f * p + 2 * 0.33335091067011297f;
  p = f * p + 2 * 0.500002877583559f;
  return square_root(exponent * (-2 * 0.6931471805599453f) + (f * f * p + (f + f)));
}

INLINE void gaussians(Generator &g, Floats &g1, Floats &g2) {
  Words a = draw(g), b = draw(g);
  Floats r = radius(__builtin_convertvector((Integers)(a >> 1), Floats) + 0.5f);
  // The low bits of b are the mantissa of a number in [2, 4): no conversion, no multiplication.
  Floats angle = (Floats)(((b >> 8) & 0x7fffffu) ^ 0x40400000u) - 3.0f;  // in quarter turns
  constexpr double unit = 1.5707963267948966, square = unit * unit, fourth = square * square;
  Floats z = angle * angle;
  Floats s = z * float(2.600054754413543e-06 * fourth * fourth * unit) -
             float(0.0001980661519421222 * fourth * square * unit);
  s = z * s + float(0.008333017291442748 * fourth * unit);
  s = z * s - float(0.166666570964985 * square * unit);
  s = z * s + float(unit);
  Floats c = z * float(2.3194386389259867e-05 * fourth * fourth) -
             float(0.0013855927179344985 * fourth * square);
  c = z * c + float(0.04166398945404269 * fourth);
  c = z * c - float(0.4999993229301647 * square);
  c = z * c + 1.0f;
  g1 = r * (Floats)((Words)c ^ (b & 0x80000000u));
  g2 = (r * angle) * s;
}

// Noise of `count` steps: [step][which of two][vector].
static __attribute__((noinline)) void fill(Generator *generators, int64_t count, Floats *noise) {
  for (int v = 0; v < VECTORS; v++) {
    Generator g = generators[v];
    for (int64_t step = 0; step < count; step++) {
      Floats *row = noise + 2 * VECTORS * step + v;
      gaussians(g, row[0], row[VECTORS]);
    }
    generators[v] = g;
  }
}

// --- the loop ------------------------------------------------------------------------------------

// The coefficients of a step, in the order in which they are handed over.
template <class Real>
struct Coefficients {
  Real decay, diffusion;
  Real drift[ORDER][ORDER], reference[ORDER], copy[ORDER];
  Real sine_gain[ORDER], copy_gain[ORDER], noise_ratio;
};

template <class Real>
INLINE typename Precision<Real>::Vector sine(typename Precision<Real>::Vector x) {
  typedef Precision<Real> P;
  typedef typename P::Bits Bits;
  auto shifted = x * Real(0.3183098861837907) + P::shifter;  // half turns, in the lowest bits
  auto rest = (shifted - P::shifter) * Real(-3.141592653589793) + x;
  auto z = rest * rest;
  auto tail = z * P::sine[0] + P::sine[1];
  for (int i = 2; i < P::terms; i++) tail = tail * z + P::sine[i];
  auto result = (rest * z) * tail + rest;
  return (typename P::Vector)((Bits)result ^ ((Bits)shifted << P::top));
}

template <class Real, class Vector = typename Precision<Real>::Vector>
INLINE void step(const Coefficients<Real> &k, Vector &phase, Vector *x, Vector g1, Vector g2) {
  Vector error = phase - k.reference[0] * x[0], copied = k.copy[0] * x[0];
  for (int j = 1; j < ORDER; j++) {
    error -= k.reference[j] * x[j];
    copied += k.copy[j] * x[j];
  }
  Vector measured = k.noise_ratio * g1 + sine<Real>(error), predicted = sine<Real>(copied);
  phase += k.decay * phase;
  phase += k.diffusion * g2;
  Vector next[ORDER];
  for (int i = 0; i < ORDER; i++) {
    next[i] = x[i];
    for (int j = 0; j < ORDER; j++) next[i] += k.drift[i][j] * x[j];
    next[i] += k.copy_gain[i] * predicted;
    next[i] += k.sine_gain[i] * measured;
  }
  for (int i = 0; i < ORDER; i++) x[i] = next[i];
}

template <class Real>
struct Block {
  typedef Precision<Real> P;
  typedef typename P::Vector Vector;
  static constexpr int vectors = LANES * sizeof(Real) / BYTES;
  Generator generators[VECTORS];
  Vector phase[vectors], x[vectors][ORDER];
  Vector turns[vectors], slips[vectors];  // where the paths are locked, and how often they moved

  Block(uint64_t seed, uint64_t first_path) : phase{}, x{}, turns{}, slips{} {
    for (int v = 0; v < VECTORS; v++) generators[v] = seeded(seed, first_path + v * WIDTH);
  }

  // Take `count` steps of `CHAINS` vectors, in registers.
  __attribute__((noinline)) void chains(const Coefficients<Real> &k, int first, int64_t count,
                                        const typename P::Noise *noise) {
    Vector phase_[CHAINS], x_[CHAINS][ORDER];
    for (int c = 0; c < CHAINS; c++) {
      phase_[c] = phase[first + c];
      for (int j = 0; j < ORDER; j++) x_[c][j] = x[first + c][j];
    }
    for (int64_t s = 0; s < count; s++) {
      const typename P::Noise *row = noise + 2 * vectors * s + first;
#pragma GCC unroll 8
      for (int c = 0; c < CHAINS; c++)
        step<Real>(k, phase_[c], x_[c], __builtin_convertvector(row[c], Vector),
                   __builtin_convertvector(row[vectors + c], Vector));
    }
    for (int c = 0; c < CHAINS; c++) {
      phase[first + c] = phase_[c];
      for (int j = 0; j < ORDER; j++) x[first + c][j] = x_[c][j];
    }
  }

  // Move a path that is three quarters of a turn from where it is locked to the next such point.
  void count_slips(const Coefficients<Real> &k) {
    constexpr Real turn = 6.283185307179586;
    const Vector zero{}, limit = zero + Real(0.75) * turn;
    for (int v = 0; v < vectors; v++) {
      Vector away = phase[v] - turns[v];
      for (int j = 0; j < ORDER; j++) away -= k.reference[j] * x[v][j];
      Vector passed = (away > limit ? zero + 1 : zero) - (away < -limit ? zero + 1 : zero);
      turns[v] += turn * passed;
      slips[v] += passed * passed;
    }
  }

  void advance(const Coefficients<Real> &k, int64_t steps) {
    Floats noise[CHUNK * 2 * VECTORS];
    for (int64_t done = 0; done < steps; done += CHUNK) {
      int64_t count = steps - done < CHUNK ? steps - done : CHUNK;
      fill(generators, count, noise);
      for (int first = 0; first < vectors; first += CHAINS)
        chains(k, first, count, (const typename P::Noise *)noise);
      count_slips(k);
    }
  }
};

// Squared errors of `paths` paths after `steps` steps: the filtered ones, then the smoothed ones, and
// then the cycle slips.
template <class Real>
static void simulate(const double *coefficients, const double *readout, int64_t steps,
                     int64_t delay, uint64_t seed, int64_t paths, double *results) {
  typedef typename Precision<Real>::Vector Vector;
  constexpr int width = BYTES / sizeof(Real);
  Coefficients<Real> k;
  for (unsigned i = 0; i < sizeof(k) / sizeof(Real); i++) ((Real *)&k)[i] = coefficients[i];
  for (int64_t path = 0; path < paths; path += LANES) {
    Block<Real> block(seed, path);
    block.advance(k, steps - delay);
    Vector delayed[Block<Real>::vectors];
    for (int v = 0; v < block.vectors; v++) delayed[v] = block.phase[v];
    block.advance(k, delay);
    for (int lane = 0; lane < LANES && path + lane < paths; lane++) {
      int v = lane / width, w = lane % width;
      double filtered = block.phase[v][w], smoothed = delayed[v][w];
      for (int j = 0; j < ORDER; j++) {
        filtered -= readout[j] * block.x[v][j][w];
        smoothed -= readout[ORDER + j] * block.x[v][j][w];
      }
      results[path + lane] = filtered * filtered;
      results[paths + path + lane] = smoothed * smoothed;
      results[2 * paths + path + lane] = block.slips[v][w];
    }
  }
}

extern "C" void single_precision(const double *coefficients, const double *readout, int64_t steps,
                                 int64_t delay, uint64_t seed, int64_t paths, double *results) {
  simulate<float>(coefficients, readout, steps, delay, seed, paths, results);
}

extern "C" void mixed_precision(const double *coefficients, const double *readout, int64_t steps,
                                int64_t delay, uint64_t seed, int64_t paths, double *results) {
  simulate<double>(coefficients, readout, steps, delay, seed, paths, results);
}
