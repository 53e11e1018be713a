/* Rotations of nodes, see rotations.py: matrices are (3, 3, n), vectors (n, 3). */
#include <math.h>
#include <stdint.h>

enum { LANES = 8, MOST = 30 };
typedef double V __attribute__((vector_size(8 * LANES))); /* numbers of so many nodes */
typedef int64_t M __attribute__((vector_size(8 * LANES)));
static const double ENOUGH = 1e-5; /* the error of an iterate is the square of its last change */

static inline V root(V x)
{
  for (int l = 0; l < LANES; ++l) x[l] = sqrt(x[l]);
  return x;
}

/* Cofactors of X, whose rows are vector products of the other two; returns the determinants. */
static inline V cofactors(const V* X, V* C)
{
  for (int i = 0; i < 3; ++i) {
    const V *b = X + 3 * ((i + 1) % 3), *c = X + 3 * ((i + 2) % 3);
    for (int j = 0; j < 3; ++j) C[3 * i + j] = b[(j + 1) % 3] * c[(j + 2) % 3] - b[(j + 2) % 3] * c[(j + 1) % 3];
  }
  return X[0] * C[0] + X[1] * C[1] + X[2] * C[2];
}

/* X <- (g X + X^-T/g)/2 with g^4 = |X^-1|^2/|X|^2, until it no longer changes. */
static inline void polar(V* X)
{
  for (int iteration = 0; iteration < MOST; ++iteration) {
    V C[9], x = {}, c = {}, most = {};
    const V d = cofactors(X, C);
    for (int i = 0; i < 9; ++i) x += X[i] * X[i], c += C[i] * C[i];
    const V g = 0.5 * root(root(c / x) / d), h = 0.25 / (g * d);
    for (int i = 0; i < 9; ++i) {
      const V y = g * X[i] + h * C[i], change = y - X[i];
      X[i] = y;
      most += change * change;
    }
    double largest = 0;
    for (int l = 0; l < LANES; ++l) largest = most[l] > largest ? most[l] : largest;
    if (!(largest > ENOUGH * ENOUGH)) break;
  }
}

/* The rotations R in F, after those `since` have been undone (if given); the identity where det F is not positive. */
void rotations(long n, const double* F, const double* since, double* R)
{
  for (long first = 0; first < n; first += LANES) {
    const int lanes = n - first < LANES ? n - first : LANES;
    V X[9], C[9];
    for (int i = 0; i < 9; ++i)
      for (int l = 0; l < LANES; ++l) X[i][l] = l < lanes ? F[i * n + first + l] : i % 4 == 0;
    const M good = cofactors(X, C) > 0.0;
    for (int i = 0; i < 9; ++i) X[i] = (V)((M)X[i] & good) + (V)((M)((V){} + (i % 4 == 0)) & ~good);
    polar(X);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        for (int l = 0; l < lanes; ++l) {
          const double* s = since ? since + 3 * j * n + first + l : 0;
          R[(3 * i + j) * n + first + l] =
              s ? X[3 * i][l] * s[0] + X[3 * i + 1][l] * s[n] + X[3 * i + 2][l] * s[2 * n] : X[3 * i + j][l];
        }
  }
}

#define TURN(r)                                                                             \
  for (long k = 0; k < n; ++k) {                                                            \
    const double a = x[3 * k], b = x[3 * k + 1], c = x[3 * k + 2];                          \
    for (int i = 0; i < 3; ++i) y[3 * k + i] = r(i, 0) * a + r(i, 1) * b + r(i, 2) * c;     \
  }
#define FORTH(i, j) R[(3 * (i) + (j)) * n + k]
#define BACK(i, j) R[(3 * (j) + (i)) * n + k]

/* Turn the first n vectors of rows, which have so many numbers each. */
void turn(long n, const double* restrict R, int back, long rows, long numbers, const double* restrict from,
          double* restrict to)
{
  for (long row = 0; row < rows; ++row) {
    const double* restrict x = from + row * numbers;
    double* restrict y = to + row * numbers;
    if (back)
      TURN(BACK)
    else
      TURN(FORTH)
    for (long k = 3 * n; k < numbers; ++k) y[k] = x[k];
  }
}
