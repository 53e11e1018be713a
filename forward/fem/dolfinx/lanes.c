/* What is around a kernel for vectors of LANES cells: types, functions, and the loop over cells. */
#include <math.h>
#include <stdint.h>
/* A vector is one register of what is compiled for; longer ones would be taken apart badly. */
#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
const int lanes = LANES;
typedef double V __attribute__((vector_size(8 * LANES)));
typedef int64_t M __attribute__((vector_size(8 * LANES)));
typedef int32_t H __attribute__((vector_size(4 * LANES)));
#define INLINE static inline __attribute__((always_inline))
/* A condition on numbers that are the same in all cells is an int. */
INLINE M same_mask(int condition) { return (M){} - condition; }
INLINE M own_mask(M condition) { return condition; }
#define MASK(x) _Generic((x), int : same_mask, default : own_mask)(x)
#define ALL(x) ((V){} + (x))
#define CHOOSE(condition, a, b) ({ M m = MASK(condition); (V)(((M)ALL(a) & m) | ((M)ALL(b) & ~m)); })
#define EACH(value) ({ V y; for (int l = 0; l < LANES; ++l) y[l] = value; y; })

#define OF(f, x) ({ V X = ALL(x); EACH(f(X[l])); })
#define OF_TWO(f, a, b) ({ V A_ = ALL(a), B_ = ALL(b); EACH(f(A_[l], B_[l])); })

#define v_sqrt(x) OF(sqrt, x)
#define v_exp(x) OF(exp, x)
#define v_log(x) OF(log, x)
#define v_sin(x) OF(sin, x)
#define v_cos(x) OF(cos, x)
#define v_sinh(x) OF(sinh, x)
#define v_cosh(x) OF(cosh, x)
#define v_tanh(x) OF(tanh, x)
#define v_atan2(a, b) OF_TWO(atan2, a, b)
#define v_fabs(x) ((V)((M)ALL(x) & INT64_MAX))
#define v_fmax(a, b) CHOOSE(ALL(a) > ALL(b), a, b)
#define v_fmin(a, b) CHOOSE(ALL(a) < ALL(b), a, b)

/* x^(-1/3) of positive x, to rounding: a guess from the exponent, off by 3 %, and two steps of the fourth order for
   1/r^3 = x. Isochoric energies are made of powers of thirds, for which vector units have no function. */
INLINE V inverse_root(V x)
{
  V high = __builtin_convertvector(__builtin_convertvector((M)x >> 32, H), V);
  M third = __builtin_convertvector(__builtin_convertvector(1430186330.0 - high * (1.0 / 3), H), M);
  V r = (V)(third << 32);
  for (int i = 0; i < 2; ++i) {
    V h = 1.0 - x * r * r * r;
    r += r * h * (1.0 / 3 + h * (2.0 / 9 + h * (14.0 / 81)));
  }
  return r;
}

INLINE V whole_power(V x, int n)
{
  V y = ALL(1.0);
  for (int m = n < 0 ? -n : n; m > 0; m >>= 1, x *= x)
    if (m & 1) y *= x;
  return n < 0 ? 1.0 / y : y;
}

/* The exponent is known to the compiler, which keeps one of these lines. */
INLINE V constant_power(V x, double p)
{
  const int n = (int)(3 * p + (p < 0 ? -0.5 : 0.5)), up = (n + 2) / 3;
  if (3 * p - n > 1e-12 || n - 3 * p > 1e-12 || n > 30 || n < -30) return OF_TWO(pow, x, p);
  if (n % 3 == 0) return whole_power(x, n / 3);
  if (n < 0) return CHOOSE(x > 0.0, whole_power(inverse_root(x), -n), __builtin_nan(""));
  return CHOOSE(x >= 0.0, whole_power(x, up) * whole_power(inverse_root(x), 3 * up - n), __builtin_nan(""));
}

INLINE V any_power(V x, V p) { return OF_TWO(pow, x, p); }
#define v_pow(x, p) _Generic((p), V : any_power, default : constant_power)(ALL(x), p)
#define KERNEL INLINE void kernel(V* restrict A, const V* restrict w, const V* restrict c, const V* restrict coordinate_dofs)

INLINE void gather_places(V* x, const double* places, int count)
{
  for (int i = 0; i < count; ++i) x[i] = EACH(places[LANES * i + l]);
}

/* Numbers at the nodes of the cells: `size` at each of `count` nodes. */
INLINE void gather(V* w, const int32_t* nodes, const double* values, int count, int size)
{
  for (int i = 0; i < count; ++i)
    for (int k = 0; k < size; ++k) w[size * i + k] = EACH(values[(int64_t)size * nodes[LANES * i + l] + k]);
}

INLINE void scatter(const V* A, const int32_t* nodes, double* out, int count, int size, int cells)
{
  for (int l = 0; l < cells; ++l)
    for (int i = 0; i < count; ++i)
      for (int k = 0; k < size; ++k) out[(int64_t)size * nodes[LANES * i + l] + k] += A[size * i + k][l];
}

INLINE void store(const V* A, double* out, int count, int cells)
{
  for (int l = 0; l < cells; ++l)
    for (int i = 0; i < count; ++i) out[count * l + i] = A[i][l];
}
