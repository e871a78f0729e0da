/* The loops, included once for each instruction set, whose registers hold WIDTH numbers. Each does, number by number, what its namesake in reference.py does. */

typedef double NAME(lanes, SET) __attribute__((vector_size(8 * WIDTH), aligned(8), may_alias));
typedef int64_t NAME(masks, SET) __attribute__((vector_size(8 * WIDTH), aligned(8), may_alias));
typedef int8_t NAME(codes, SET) __attribute__((vector_size(WIDTH)));
#define LANES NAME(lanes, SET)
#define MASKS NAME(masks, SET)

/* The last trials, where there are fewer than WIDTH. */
static __attribute__((noinline)) LANES NAME(load_some, SET)(const double *from, int64_t count) {
  LANES value = {0.0};
  for (int64_t t = 0; t < count; t++) value[t] = from[t];
  return value;
}

static __attribute__((noinline)) void NAME(store_some, SET)(double *to, LANES value, int64_t count) {
  for (int64_t t = 0; t < count; t++) to[t] = value[t];
}

static inline __attribute__((always_inline)) LANES NAME(load, SET)(const double *from, int64_t count) {
  return count >= WIDTH ? *(const LANES *)from : NAME(load_some, SET)(from, count);
}

static inline __attribute__((always_inline)) void NAME(store, SET)(double *to, LANES value, int64_t count) {
  if (count >= WIDTH)
    *(LANES *)to = value;
  else
    NAME(store_some, SET)(to, value, count);
}

/* All bits set in the lanes whose code is `wanted`. */
static inline __attribute__((always_inline)) MASKS NAME(lanes_with, SET)(const uint8_t *codes, int64_t count, uint8_t wanted) {
  NAME(codes, SET) some = {0};
  if (count >= WIDTH)
    memcpy(&some, codes, sizeof some);
  else
    for (int64_t t = 0; t < count; t++) some[t] = (int8_t)codes[t];
  return __builtin_convertvector(some == (int8_t)wanted, MASKS);
}

static inline __attribute__((always_inline)) LANES NAME(choose, SET)(MASKS mask, LANES yes, LANES no) {
  return (LANES)((mask & (MASKS)yes) | (~mask & (MASKS)no));
}

#define TRIALS_AT_ONCE 32 /* whose lines of the cache are written in turns */
#define LOAD NAME(load, SET)
#define STORE NAME(store, SET)
#define LANES_WITH NAME(lanes_with, SET)
#define SELECT NAME(choose, SET)

static void NAME(counters, SET)(int64_t slots, int64_t count, uint64_t slot, uint64_t first, uint64_t *out) {
  for (int64_t s = 0; s < slots; s++) {
    uint64_t high = __builtin_bswap64(slot + (uint64_t)s);
    uint64_t *row = out + 2 * s * count;
    for (int64_t i = 0; i < count; i++) {
      row[2 * i] = high;
      row[2 * i + 1] = __builtin_bswap64(first + (uint64_t)i);
    }
  }
}

static void NAME(uniforms, SET)(int64_t rows, int64_t trials, int64_t stride, int64_t width, const uint64_t *words,
                                double *out) {
  for (int64_t s = 0; s < rows; s++)
    for (int64_t j = 0; j < width; j++) {
      const uint64_t *from = words + s * trials * stride + j;
      double *to = out + (s * width + j) * trials;
      for (int64_t r = 0; r < trials; r++) to[r] = (double)(int64_t)(from[r * stride] >> 11) * 0x1p-53;
    }
}

#include "quantile.h"

static inline __attribute__((always_inline)) void NAME(product_of, SET)(int64_t rows, int64_t m, int64_t n, int64_t trials,
                                                                        const double *M, const double *x, double *out) {
  for (int64_t s = 0; s < rows; s++, M += m * n, x += n * trials, out += m * trials)
    for (int64_t r = 0; r < trials; r += WIDTH) {
      int64_t w = trials - r;
      for (int64_t i = 0; i < m; i++) {
        LANES y = M[i * n] * LOAD(x + r, w);
        for (int64_t j = 1; j < n; j++) y += M[i * n + j] * LOAD(x + j * trials + r, w);
        STORE(out + i * trials + r, y, w);
      }
    }
}

static void NAME(product, SET)(int64_t rows, int64_t m, int64_t n, int64_t trials, const double *M, const double *x,
                               double *out) {
  if (m == 2 && n == 2)
    NAME(product_of, SET)(rows, 2, 2, trials, M, x, out);
  else
    NAME(product_of, SET)(rows, m, n, trials, M, x, out);
}

static inline __attribute__((always_inline)) void NAME(advance_of, SET)(int64_t slots, int64_t n, int64_t trials,
                                                                        const double *A, const double *noise,
                                                                        const double *before, double *predicted, double *x) {
  int64_t size = n * trials;
  for (int64_t s = 0; s < slots; s++, noise += size, predicted += size, before = x, x += size)
    for (int64_t r = 0; r < trials; r += WIDTH) {
      int64_t w = trials - r;
      for (int64_t i = 0; i < n; i++) {
        LANES y = A[i * n] * LOAD(before + r, w);
        for (int64_t j = 1; j < n; j++) y += A[i * n + j] * LOAD(before + j * trials + r, w);
        STORE(predicted + i * trials + r, y, w);
        STORE(x + i * trials + r, y + LOAD(noise + i * trials + r, w), w);
      }
    }
}

static void NAME(advance, SET)(int64_t slots, int64_t n, int64_t trials, const double *A, const double *noise,
                               const double *before, double *predicted, double *x) {
  if (n == 2)
    NAME(advance_of, SET)(slots, 2, trials, A, noise, before, predicted, x);
  else
    NAME(advance_of, SET)(slots, n, trials, A, noise, before, predicted, x);
}

static void NAME(encode, SET)(int64_t slots, int64_t n, int64_t trials, const uint8_t *nu, const double *x,
                              const double *predicted, const double *chi, double *z) {
  for (int64_t s = 0; s < slots; s++, nu += trials)
    for (int64_t r = 0; r < trials; r += WIDTH) {
      int64_t w = trials - r;
      MASKS states = LANES_WITH(nu + r, w, 0);
      for (int64_t i = 0; i < n; i++) {
        int64_t at = (s * n + i) * trials + r;
        LANES state = LOAD(x + at, w);
        STORE(z + at, SELECT(states, state, (state - LOAD(predicted + at, w)) + LOAD(chi + at, w)), w);
      }
    }
}

#include "belief.h"
#include "mixture.h"

static inline __attribute__((always_inline)) void NAME(records_of, SET)(int64_t slots, int64_t trials, int64_t first,
                                                                        int64_t count, const uint8_t *marks, int64_t width,
                                                                        const double *a, int64_t n, const double *P,
                                                                        uint8_t *out) {
  int64_t size = 1 + 8 * (width + n * (n + 1) / 2);
  for (int64_t start = 0; start < count; start += TRIALS_AT_ONCE) {
    int64_t end = start + TRIALS_AT_ONCE < count ? start + TRIALS_AT_ONCE : count;
    for (int64_t s = 0; s < slots; s++) {
      const uint8_t *mark = marks + s * trials + first;
      const double *from_a = a + s * width * trials + first, *from_P = n ? P + s * n * n * trials + first : NULL;
      for (int64_t r = start; r < end; r++) {
        uint8_t *to = out + (r * slots + s) * size;
        *to++ = mark[r] != 0;
        for (int64_t i = 0; i < width; i++, to += 8) memcpy(to, from_a + i * trials + r, 8);
        for (int64_t i = 0; i < n; i++)
          for (int64_t j = i; j < n; j++, to += 8) memcpy(to, from_P + (i * n + j) * trials + r, 8);
      }
    }
  }
}

static void NAME(records, SET)(int64_t slots, int64_t trials, int64_t first, int64_t count, const uint8_t *marks,
                               int64_t width, const double *a, int64_t n, const double *P, uint8_t *out) {
  if (width == 2 && n == 2)
    NAME(records_of, SET)(slots, trials, first, count, marks, 2, a, 2, P, out);
  else
    NAME(records_of, SET)(slots, trials, first, count, marks, width, a, n, P, out);
}

static void NAME(squared_errors, SET)(int64_t slots, int64_t n, int64_t trials, const double *x, const double *x_hat,
                                      double *out) {
  for (int64_t s = 0; s < slots; s++, x += n * trials, x_hat += n * trials, out += trials)
    for (int64_t r = 0; r < trials; r += WIDTH) {
      int64_t w = trials - r;
      LANES error = LOAD(x + r, w) - LOAD(x_hat + r, w), sum = error * error;
      for (int64_t i = 1; i < n; i++) {
        error = LOAD(x + i * trials + r, w) - LOAD(x_hat + i * trials + r, w);
        sum += error * error;
      }
      STORE(out + r, sum, w);
    }
}

static void NAME(traces, SET)(int64_t slots, int64_t n, int64_t trials, const double *P, double *out) {
  for (int64_t s = 0; s < slots; s++, P += n * n * trials, out += trials)
    for (int64_t r = 0; r < trials; r += WIDTH) {
      int64_t w = trials - r;
      LANES sum = LOAD(P + r, w);
      for (int64_t i = 1; i < n; i++) sum += LOAD(P + i * (n + 1) * trials + r, w);
      STORE(out + r, sum, w);
    }
}

/* The sums of numbers and of their squares, in numpy's order: eight sums of up to 128 numbers, halves of more. */
static void NAME(sums_of, SET)(int64_t count, const double *values, double *sums) {
  if (count > 128) {
    int64_t half = count / 2 - count / 2 % 8;
    double more[2];
    NAME(sums_of, SET)(half, values, sums);
    NAME(sums_of, SET)(count - half, values + half, more);
    sums[0] += more[0];
    sums[1] += more[1];
    return;
  }
  int64_t i = 0;
  sums[0] = sums[1] = 0.0;
  if (count >= 8) {
    double of[8] = {0.0}, squares[8] = {0.0};
    for (; i < count - count % 8; i += 8)
      for (int64_t j = 0; j < 8; j++) {
        of[j] += values[i + j];
        squares[j] += values[i + j] * values[i + j];
      }
    sums[0] = ((of[0] + of[1]) + (of[2] + of[3])) + ((of[4] + of[5]) + (of[6] + of[7]));
    sums[1] = ((squares[0] + squares[1]) + (squares[2] + squares[3])) + ((squares[4] + squares[5]) + (squares[6] + squares[7]));
  }
  for (; i < count; i++) {
    sums[0] += values[i];
    sums[1] += values[i] * values[i];
  }
}

static void NAME(sums, SET)(int64_t slots, int64_t trials, const double *values, double *out) {
  for (int64_t s = 0; s < slots; s++) NAME(sums_of, SET)(trials, values + s * trials, out + 2 * s);
}

#define TILE 192 /* below 256: a byte counts the codes of a tile */

static void NAME(count_codes, SET)(int64_t slots, int64_t trials, const uint8_t *codes, int64_t kinds, uint32_t *counts) {
  for (int64_t s = 0; s < slots; s++, codes += trials, counts += kinds)
    for (int64_t start = 0; start < trials; start += TILE) {
      int64_t count = trials - start < TILE ? trials - start : TILE;
      for (int64_t i = 0; i < kinds && i < 256; i++) {
        uint8_t found = 0;
        for (int64_t r = 0; r < count; r++) found += codes[start + r] == (uint8_t)i;
        counts[i] += found;
      }
    }
}
#undef TILE

static void NAME(add_between, SET)(int64_t slots, int64_t trials, const uint8_t *state, const double *traces, double *total,
                                   double *mark, double *squares) {
  for (int64_t s = 0; s < slots; s++, state += trials, traces += trials)
    for (int64_t r = 0; r < trials; r++) {
      double between = (total[r] - mark[r]) * (double)state[r];
      mark[r] += between;
      squares[r] += between * between;
      total[r] += traces[r];
    }
}

static void NAME(add_leaked, SET)(int64_t slots, int64_t trials, const uint8_t *heard, const uint8_t *nu, const double *by_type,
                                  double *bits, double *clear) {
  for (int64_t s = 0; s < slots; s++, heard += trials, nu += trials, by_type += 2) {
    double of[2], all[2];
    for (int i = 0; i < 2; i++) {
      all[i] = isinf(by_type[i]) ? 1.0 : 0.0;
      of[i] = isinf(by_type[i]) ? 0.0 : by_type[i];
    }
    for (int64_t r = 0; r < trials; r++) {
      bits[r] += heard[r] ? (nu[r] ? of[1] : of[0]) : 0.0;
      clear[r] += heard[r] ? (nu[r] ? all[1] : all[0]) : 0.0;
    }
  }
}

#define TILE 256

static void NAME(bursts, SET)(int64_t slots, int64_t trials, const uint8_t *codes, uint8_t lost, int64_t *run, int64_t most,
                              uint32_t *counts) {
  for (int64_t s = 0; s < slots; s++, codes += trials)
    for (int64_t start = 0; start < trials; start += TILE) {
      int64_t count = trials - start < TILE ? trials - start : TILE, ends = 0;
      int64_t ended[TILE], length[TILE];
      for (int64_t r = 0; r < count; r++) {
        int64_t goes_on = codes[start + r] == lost, now = run[start + r];
        ended[r] = goes_on ? 0 : now;
        run[start + r] = (now + 1) & -goes_on;
      }
      for (int64_t r = 0; r < count; r++) {
        length[ends] = ended[r];
        ends += ended[r] > 0;
      }
      for (int64_t i = 0; i < ends; i++) counts[(length[i] < most ? length[i] : most) - 1]++;
    }
}

/* Counts go to several tables in turns: an increment waits for the last one, which is often of the same bin. */
#define TABLES 4
#define MOST_BINS 512

static void NAME(histogram, SET)(int64_t rows, int64_t trials, const double *values, int shift, int64_t base, int64_t bins,
                                 uint32_t *counts) {
  uint32_t all[MOST_BINS][TABLES];
  int64_t tables = bins <= MOST_BINS && bins <= trials ? TABLES : 1;
  for (int64_t s = 0; s < rows; s++, counts += bins) {
    if (tables > 1) memset(all, 0, (size_t)bins * sizeof *all);
    for (int64_t start = 0; start < trials; start += TILE, values += TILE) {
      int64_t count = trials - start < TILE ? trials - start : TILE;
      int64_t place[TILE];
      for (int64_t r = 0; r < count; r++) {
        int64_t bits;
        memcpy(&bits, values + r, sizeof bits);
        bits = (bits >> shift) - base;
        bits = bits < bins ? bits : bins - 1;
        place[r] = bits < 0 ? 0 : bits;
      }
      if (tables > 1)
        for (int64_t r = 0; r < count; r++) all[place[r]][r % TABLES]++;
      else
        for (int64_t r = 0; r < count; r++) counts[place[r]]++;
    }
    values += trials - (trials + TILE - 1) / TILE * TILE;
    if (tables > 1)
      for (int64_t i = 0; i < bins; i++)
        for (int64_t t = 0; t < TABLES; t++) counts[i] += all[i][t];
  }
}
#undef MOST_BINS
#undef TABLES
#undef TILE

static void NAME(scatter, SET)(int64_t slots, int64_t n, int64_t trials, const uint8_t *flags, const double *packed,
                               double *z) {
  for (int64_t s = 0; s < slots; s++, flags += trials, z += n * trials) {
    int64_t count = 0;
    for (int64_t r = 0; r < trials; r++) count += flags[r];
    if (count == 0 || count == trials) {
      if (count)
        memcpy(z, packed, (size_t)(n * trials) * sizeof *z);
      else
        memset(z, 0, (size_t)(n * trials) * sizeof *z);
    } else
      for (int64_t i = 0; i < n; i++) {
        int64_t j = 0;
        for (int64_t r = 0; r < trials; r++) { /* without a branch: the number is masked where the flag is 0 */
          uint64_t bits;
          memcpy(&bits, packed + i * count + (j < count ? j : count - 1), sizeof bits);
          bits &= -(uint64_t)flags[r];
          memcpy(z + i * trials + r, &bits, sizeof bits);
          j += flags[r];
        }
      }
    packed += n * count;
  }
}

static void NAME(gather, SET)(int64_t slots, int64_t n, int64_t trials, const uint8_t *flags, const double *x, double *out) {
  for (int64_t s = 0; s < slots; s++, flags += trials) {
    int64_t count = 0;
    for (int64_t r = 0; r < trials; r++) count += flags[r];
    for (int64_t i = 0; i < n; i++, x += trials, out += count)
      for (int64_t r = 0, j = 0; j < count && r < trials; r++) {
        out[j] = x[r];
        j += flags[r];
      }
  }
}

#undef LANES
#undef MASKS
#undef LOAD
#undef TRIALS_AT_ONCE
#undef STORE
#undef LANES_WITH
#undef SELECT
