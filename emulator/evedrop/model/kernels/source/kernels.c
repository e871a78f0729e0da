/* The kernels, compiled for several instruction sets; the processor's is chosen when they are loaded.

   All sets give the same bits: only + - * / sqrt and comparisons, each rounded on its own (no contraction, no fast-math). */
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if FLT_EVAL_METHOD != 0
#error "this compiler keeps more than double precision between operations; numpy's code is used instead"
#endif
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the kernels read little-endian numbers; numpy's code is used instead"
#endif

#include "kernels.h"

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wpsabi" /* functions with vector arguments are all inlined */
#endif

#define JOIN(name, set) name##_##set
#define NAME(name, set) JOIN(name, set)

#define SET baseline
#define WIDTH 2
#include "loops.h"
#undef WIDTH
#undef SET

#if defined(__x86_64__) && (defined(__clang__) || defined(__GNUC__))
#include <cpuid.h>
#define SETS 3
#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2")
#endif
#define SET avx2
#define WIDTH 4
#include "loops.h"
#undef WIDTH
#undef SET
#if defined(__clang__)
#pragma clang attribute pop
#pragma clang attribute push(__attribute__((target("avx512f,avx512dq,avx512bw,avx512vl"))), apply_to = function)
#else
#pragma GCC pop_options
#pragma GCC push_options
#pragma GCC target("avx512f,avx512dq,avx512bw,avx512vl")
#endif
#define SET avx512
#define WIDTH 8
#include "loops.h"
#undef WIDTH
#undef SET
#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

/* Asked of the processor itself: the compilers' own functions for this are not in every one of their libraries. */
int kernels_best(void) {
  unsigned a, b, c, d, saved, unused;
  if (!__get_cpuid(1, &a, &b, &c, &d) || !(c >> 27 & 1) || !(c >> 28 & 1)) return 0;
  __asm__("xgetbv" : "=a"(saved), "=d"(unused) : "c"(0)); /* the registers that the operating system saves */
  if ((saved & 0x06) != 0x06 || !__get_cpuid_count(7, 0, &a, &b, &c, &d) || !(b >> 5 & 1)) return 0;
  int wide = b >> 16 & b >> 17 & b >> 30 & b >> 31 & 1; /* F, DQ, BW and VL */
  return wide && (saved & 0xe6) == 0xe6 ? 2 : 1;
}
#else
#define SETS 1
int kernels_best(void) { return 0; }
#endif

static int used = 0;

void kernels_use(int set) { used = set < 0 ? 0 : set > kernels_best() ? kernels_best() : set; }

#if SETS == 3
#define CHOOSE(name, arguments) \
  (used == 2 ? NAME(name, avx512) arguments : used == 1 ? NAME(name, avx2) arguments : NAME(name, baseline) arguments)
#else
#define CHOOSE(name, arguments) (NAME(name, baseline) arguments)
#endif

void kernels_counters(int64_t slots, int64_t count, uint64_t slot, uint64_t first, uint64_t *out) {
  CHOOSE(counters, (slots, count, slot, first, out));
}

void kernels_uniforms(int64_t rows, int64_t trials, int64_t stride, int64_t width, const uint64_t *words, double *out) {
  CHOOSE(uniforms, (rows, trials, stride, width, words, out));
}

void kernels_normals(int64_t rows, int64_t trials, int64_t stride, int64_t width, const uint64_t *words, double *out) {
  CHOOSE(normals, (rows, trials, stride, width, words, out));
}

void kernels_product(int64_t rows, int64_t m, int64_t n, int64_t trials, const double *M, const double *x, double *out) {
  CHOOSE(product, (rows, m, n, trials, M, x, out));
}

void kernels_advance(int64_t slots, int64_t n, int64_t trials, const double *A, const double *noise, const double *before,
                     double *predicted, double *x) {
  CHOOSE(advance, (slots, n, trials, A, noise, before, predicted, x));
}

void kernels_encode(int64_t slots, int64_t n, int64_t trials, const uint8_t *nu, const double *x, const double *predicted,
                    const double *chi, double *z) {
  CHOOSE(encode, (slots, n, trials, nu, x, predicted, chi, z));
}

int kernels_follow(int64_t slots, int64_t n, int64_t trials, int initial, const double *A, const double *Q,
                   const double *x_hat, const double *P, const uint8_t *action, const double *z, const double *chi,
                   double *new_x, double *new_P) {
  return CHOOSE(follow, (slots, n, trials, initial, A, Q, x_hat, P, action, z, chi, new_x, new_P));
}

void kernels_records(int64_t slots, int64_t trials, int64_t first, int64_t count, const uint8_t *marks, int64_t width,
                     const double *a, int64_t n, const double *P, uint8_t *out) {
  CHOOSE(records, (slots, trials, first, count, marks, width, a, n, P, out));
}

void kernels_squared_errors(int64_t slots, int64_t n, int64_t trials, const double *x, const double *x_hat, double *out) {
  CHOOSE(squared_errors, (slots, n, trials, x, x_hat, out));
}

void kernels_traces(int64_t slots, int64_t n, int64_t trials, const double *P, double *out) {
  CHOOSE(traces, (slots, n, trials, P, out));
}

void kernels_sums(int64_t slots, int64_t trials, const double *values, double *out) {
  CHOOSE(sums, (slots, trials, values, out));
}

void kernels_add_between(int64_t slots, int64_t trials, const uint8_t *state, const double *traces, double *total,
                         double *mark, double *squares) {
  CHOOSE(add_between, (slots, trials, state, traces, total, mark, squares));
}

void kernels_add_leaked(int64_t slots, int64_t trials, const uint8_t *heard, const uint8_t *nu, const double *by_type,
                        double *bits, double *clear) {
  CHOOSE(add_leaked, (slots, trials, heard, nu, by_type, bits, clear));
}

void kernels_count_codes(int64_t slots, int64_t trials, const uint8_t *codes, int64_t kinds, uint32_t *counts) {
  CHOOSE(count_codes, (slots, trials, codes, kinds, counts));
}

void kernels_bursts(int64_t slots, int64_t trials, const uint8_t *codes, uint8_t lost, int64_t *run, int64_t most,
                    uint32_t *counts) {
  CHOOSE(bursts, (slots, trials, codes, lost, run, most, counts));
}

void kernels_histogram(int64_t rows, int64_t trials, const double *values, int shift, int64_t base, int64_t bins,
                       uint32_t *counts) {
  CHOOSE(histogram, (rows, trials, values, shift, base, bins, counts));
}

void kernels_scatter(int64_t slots, int64_t n, int64_t trials, const uint8_t *flags, const double *packed, double *z) {
  CHOOSE(scatter, (slots, n, trials, flags, packed, z));
}

void kernels_gather(int64_t slots, int64_t n, int64_t trials, const uint8_t *flags, const double *x, double *out) {
  CHOOSE(gather, (slots, n, trials, flags, x, out));
}

int kernels_triangularise(int64_t count, int64_t n, int64_t m, double *M) {
  int failed = 0;
  for (int64_t i = 0; i < count && !failed; i++) failed = CHOOSE(triangularise, (n, m, M + i * n * m));
  return failed;
}

int kernels_carried_factors(int64_t n, int64_t slots, const double *A, const double *G, const double *carried, double *out) {
  return CHOOSE(carried_factors, (n, slots, A, G, carried, out));
}

int64_t kernels_follow_mixture(int64_t slots, int64_t n, int64_t trials, int64_t before, int64_t capacity, int initial,
                               const double *A, const double *G, const double *leaks, const double *rounding,
                               double state_probability, const double *weight, const double *mean, const double *lower, const double *diagonal,
                               const uint8_t *gamma, const double *z, double *x_hat, double *P, uint8_t *action,
                               double *weight_after, double *mean_after, double *lower_after, double *diagonal_after) {
  return CHOOSE(follow_mixture, (slots, n, trials, before, capacity, initial, A, G, leaks, rounding, state_probability, weight, mean,
                                 lower, diagonal, gamma, z, x_hat, P, action, weight_after, mean_after, lower_after,
                                 diagonal_after));
}
