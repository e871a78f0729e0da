/* The Bayesian eavesdropper's slots, WIDTH trials at a time: mixtures.py. */

#include "factored.h"

#ifndef MIXTURE
#define MIXTURE
#define NEGLIGIBLE 1e-12
#define CERTAIN 300.0
#define SURE 1e300
#define IMPOSSIBLE -700.0
#endif

static inline __attribute__((always_inline)) int NAME(any, SET)(MASKS mask) {
  int64_t found = 0;
  for (int t = 0; t < WIDTH; t++) found |= mask[t];
  return found != 0;
}

/* exp(x) as in elementary.py, for IMPOSSIBLE < x <= CERTAIN, where no result is subnormal or infinite. */
static inline __attribute__((always_inline)) LANES NAME(exponential, SET)(LANES x) {
  LANES shifted = x * 1.44269504088896338700e00 + 0x1.8p52, power = shifted - 0x1.8p52; /* rounded to an integer */
  LANES high = x - power * 6.93147180369123816490e-01, low = power * 1.90821492927058770002e-10, r = high - low, t = r * r;
  LANES sum = 4.13813679705723846039e-08 * t;
  sum = (((sum + -1.65339022054652515390e-06) * t + 6.61375632143793436117e-05) * t + -2.77777777770155933842e-03) * t +
        1.66666666666666019037e-01;
  LANES c = r - t * sum, value = 1.0 - ((low - (r * c) / (2.0 - c)) - high);
  MASKS exponent = ((MASKS)shifted - (MASKS)NAME(splat, SET)(0x1.8p52) + 1023) << 52;
  return value * (LANES)exponent;
}

/* A mixture of WIDTH trials, place by place, and work space; all of one allocation. */
typedef struct {
  LANES *weight, *mean, *lower, *diagonal;                          /* (C,), (C, n), (C, n (n-1)/2), (C, n) */
  LANES *z, *white, *told, *apart, *e, *seen, *lower_after, *diagonal_after; /* of a slot, and of a component after it */
  ENTRY *A, *noise_unit, *noise, *known_unit, *known;               /* (n, n), (n, n), (n,), (n, n), (n,) */
  ENTRY *carried, *products, *rows, *weights, *weighted, *first;    /* (n, n), (n,), (n, 2n + 1), (2n + 1,) twice, (n,) */
} NAME(mixture, SET);
#define MIXTURES NAME(mixture, SET)

static int NAME(new_mixture, SET)(int64_t n, int64_t capacity, MIXTURES *m) {
  int64_t below = BELOW(n, 0), lanes = capacity * (1 + 2 * n + below) + 7 * n + below, entries = 6 * n * n + 10 * n + 2;
  m->weight = calloc(1, (size_t)lanes * sizeof(LANES));
  m->A = calloc(1, (size_t)entries * sizeof(ENTRY));
  if (!m->weight || !m->A) return -1;
  m->mean = m->weight + capacity;
  m->diagonal = m->mean + capacity * n;
  m->lower = m->diagonal + capacity * n;
  m->z = m->lower + capacity * below;
  m->white = m->z + n;
  m->told = m->white + n;
  m->apart = m->told + n;
  m->e = m->apart + n;
  m->seen = m->e + n;
  m->diagonal_after = m->seen + n;
  m->lower_after = m->diagonal_after + n;
  m->noise_unit = m->A + n * n;
  m->known_unit = m->noise_unit + n * n;
  m->carried = m->known_unit + n * n;
  m->rows = m->carried + n * n;
  m->noise = m->rows + n * (2 * n + 1);
  m->known = m->noise + n;
  m->products = m->known + n;
  m->first = m->products + n;
  m->weights = m->first + n;
  m->weighted = m->weights + 2 * n + 1;
  return 0;
}

/* One component one slot later, and its part in the packet's ratio of densities. heard: where there is a component, and a packet;
   joint: the slot's [[L, 0], [gain, M]]; rounding: the least variance of packets about their prediction, (n,). */
static inline __attribute__((always_inline)) LANES NAME(component, SET)(int64_t n, const double *A, const double *joint,
                                                                        const double *rounding, MASKS heard, LANES alone,
                                                                        LANES weight,
                                                                        LANES *mean, LANES *lower, LANES *diagonal,
                                                                        MIXTURES *m) {
  LANES ratio = {0.0};
  int64_t below = BELOW(n, 0);
  for (int64_t i = 0; i < n; i++) {
    LANES y = A[i * n] * mean[0];
    for (int64_t j = 1; j < n; j++) y += A[i * n + j] * mean[j];
    m->e[i] = y;
  }
  for (int64_t i = 0; i < n; i++) mean[i] = m->e[i];
  NAME(carried_rows, SET)(n, m->A, lower, diagonal, m->carried, m->products, m->weighted);
  NAME(grown, SET)(n, m->carried, m->products, diagonal, m->noise_unit, m->noise, m->rows, m->weights, m->weighted, m->first,
                   m->lower_after, m->diagonal_after);
  if (NAME(any, SET)(heard)) {
    for (int64_t i = 0; i < n; i++) {
      LANES least = NAME(splat, SET)(rounding[i]), D = m->diagonal_after[i];
      m->apart[i] = m->z[i] - mean[i];
      m->seen[i] = SELECT((MASKS)(D > least), D, least);
    }
    LANES exponent = 0.5 * (alone - NAME(squared_length, SET)(n, m->lower_after, m->seen, m->apart, m->e));
    MASKS some = (MASKS)(exponent > NAME(splat, SET)(IMPOSSIBLE)) & heard;
    if (NAME(any, SET)(some)) {
      LANES determinant = NAME(splat, SET)(1.0), most = NAME(splat, SET)(CERTAIN), sure = NAME(splat, SET)(SURE), root;
      for (int64_t i = 0; i < n; i++) {
        double pivot = joint[i * (2 * n + 1)];
        LANES none = {0.0}, D = m->diagonal_after[i];
        determinant *= SELECT((MASKS)(D > none), m->seen[i], D) / (pivot * pivot);
      }
      exponent = (LANES)(some & (MASKS)SELECT((MASKS)(exponent > most), most, exponent));
      for (int t = 0; t < WIDTH; t++) root[t] = sqrt(determinant[t]);
      ratio = weight * NAME(exponential, SET)(exponent) / root;
      ratio = (LANES)(some & (MASKS)SELECT((MASKS)(ratio > sure), sure, ratio));
    }
    for (int64_t i = 0; i < n; i++) mean[i] = mean[i] + m->told[i];
    /* `lower` and `diagonal` are still those before the slot. */
    NAME(grown, SET)(n, m->carried, m->products, diagonal, m->known_unit, m->known, m->rows, m->weights, m->weighted, m->first,
                     lower, m->e);
    for (int64_t i = 0; i < below; i++) lower[i] = SELECT(heard, lower[i], m->lower_after[i]);
    for (int64_t i = 0; i < n; i++) diagonal[i] = SELECT(heard, m->e[i], m->diagonal_after[i]);
  } else {
    LANES none = {0.0};
    for (int64_t i = 0; i < n; i++) mean[i] = mean[i] + none;
    for (int64_t i = 0; i < below; i++) lower[i] = m->lower_after[i];
    for (int64_t i = 0; i < n; i++) diagonal[i] = m->diagonal_after[i];
  }
  return ratio;
}

/* The two least probable components of some trials become one; the second place is then empty. Rare, so number by number. */
static __attribute__((noinline)) void NAME(merge, SET)(int64_t n, int64_t capacity, MASKS full, MIXTURES *m) {
  int64_t below = BELOW(n, 0), width = 2 * n + 1, one[WIDTH], two[WIDTH], which[WIDTH];
  double *weight = (double *)m->weight, *mean = (double *)m->mean, *lower = (double *)m->lower, *diagonal = (double *)m->diagonal;
  double w[2][WIDTH], share[WIDTH], total[WIDTH];
  memcpy(which, &full, sizeof which);
  for (int64_t i = 0; i < n; i++)
    for (int64_t c = 0; c < width; c++)
      m->rows[i * width + c] = NAME(plain, SET)(c == i || c == n + i ? 1.0 : 0.0);
  for (int64_t t = 0; t < WIDTH; t++) {
    int64_t first = 0, second = 0;
    for (int64_t p = 1; p < capacity; p++)
      if (weight[p * WIDTH + t] < weight[first * WIDTH + t]) first = p;
    for (int64_t p = 0; p < capacity; p++)
      if (p != first && weight[p * WIDTH + t] < (second == first ? INFINITY : weight[second * WIDTH + t])) second = p;
    one[t] = first;
    two[t] = second;
    w[0][t] = weight[first * WIDTH + t];
    w[1][t] = weight[second * WIDTH + t];
    for (int64_t i = 0; i < n; i++) {
      ENTRY *row = m->rows + i * width;
      const double *a = diagonal + (first * n + i) * WIDTH, *b = diagonal + (second * n + i) * WIDTH;
      ((double *)&m->apart[i])[t] = mean[(second * n + i) * WIDTH + t] - mean[(first * n + i) * WIDTH + t];
      ((double *)&m->weights[i].value)[t] = a[t];
      ((double *)&m->weights[n + i].value)[t] = b[t];
      for (int64_t j = 0; j < i; j++) {
        ((double *)&row[j].value)[t] = lower[(first * below + BELOW(i, j)) * WIDTH + t];
        ((double *)&row[n + j].value)[t] = lower[(second * below + BELOW(i, j)) * WIDTH + t];
        row[j].kind = row[n + j].kind = VARIED;
      }
    }
  }
  LANES sum = LOAD(w[0], WIDTH) + LOAD(w[1], WIDTH), a = LOAD(w[0], WIDTH) / sum, b = LOAD(w[1], WIDTH) / sum;
  for (int64_t i = 0; i < n; i++) {
    m->weights[i] = NAME(varied, SET)(a * m->weights[i].value);
    m->weights[n + i] = NAME(varied, SET)(b * m->weights[n + i].value);
    m->rows[i * width + 2 * n] = NAME(varied, SET)(m->apart[i]);
  }
  m->weights[2 * n] = NAME(varied, SET)(a * b);
  NAME(orthogonalised, SET)(n, width, m->rows, m->weights, NULL, m->weighted, m->lower_after, m->diagonal_after);
  STORE(total, sum, WIDTH);
  STORE(share, b, WIDTH);
  for (int64_t t = 0; t < WIDTH; t++) {
    if (!which[t]) continue;
    for (int64_t i = 0; i < n; i++) {
      mean[(one[t] * n + i) * WIDTH + t] += share[t] * ((double *)&m->apart[i])[t];
      diagonal[(one[t] * n + i) * WIDTH + t] = ((double *)&m->diagonal_after[i])[t];
    }
    for (int64_t i = 0; i < below; i++) lower[(one[t] * below + i) * WIDTH + t] = ((double *)&m->lower_after[i])[t];
    weight[one[t] * WIDTH + t] = total[t];
    weight[two[t] * WIDTH + t] = 0.0;
  }
}

/* A new component for each packet, in the first empty place, weighted by `state`; returns the trials without an empty place. */
static inline __attribute__((always_inline)) MASKS NAME(placed, SET)(int64_t n, int64_t capacity, MASKS waiting, LANES state,
                                                                     MIXTURES *m) {
  LANES none = {0.0};
  int64_t below = BELOW(n, 0);
  for (int64_t p = 0; p < capacity && NAME(any, SET)(waiting); p++) {
    MASKS here = (MASKS)(m->weight[p] == none) & waiting;
    waiting &= ~here;
    if (!NAME(any, SET)(here)) continue;
    m->weight[p] = SELECT(here, state, m->weight[p]);
    for (int64_t i = 0; i < n; i++) m->mean[p * n + i] = SELECT(here, m->z[i], m->mean[p * n + i]);
    for (int64_t i = 0; i < n; i++) m->diagonal[p * n + i] = (LANES)(~here & (MASKS)m->diagonal[p * n + i]);
    for (int64_t i = 0; i < below; i++) m->lower[p * below + i] = (LANES)(~here & (MASKS)m->lower[p * below + i]);
  }
  return waiting;
}

/* Mean and covariance of the mixture. */
static inline __attribute__((always_inline)) void NAME(moments, SET)(int64_t n, int64_t places, int64_t trials, int64_t w,
                                                                     double *x_hat, double *P, MIXTURES *m) {
  LANES none = {0.0};
  int64_t below = BELOW(n, 0);
  LANES *middle = m->e, *away = m->apart, *weighted = m->diagonal_after, *sums = (LANES *)m->rows;
  for (int64_t i = 0; i < n; i++) middle[i] = none;
  for (int64_t i = 0; i < n * n; i++) sums[i] = none;
  for (int64_t p = 0; p < places; p++) {
    MASKS there = (MASKS)(m->weight[p] != none);
    for (int64_t i = 0; i < n; i++)
      middle[i] += (LANES)(there & (MASKS)(m->weight[p] * m->mean[p * n + i]));
  }
  for (int64_t p = 0; p < places; p++) {
    MASKS there = (MASKS)(m->weight[p] != none);
    const LANES *U = m->lower + p * below, *D = m->diagonal + p * n;
    if (!NAME(any, SET)(there)) continue;
    for (int64_t i = 0; i < n; i++) away[i] = m->mean[p * n + i] - middle[i];
    for (int64_t j = 0; j < n; j++) {
      for (int64_t c = 0; c < j; c++) weighted[c] = D[c] * U[BELOW(j, c)];
      weighted[j] = D[j];
      for (int64_t i = j; i < n; i++) {
        LANES within = weighted[0];
        if (i) within *= U[BELOW(i, 0)];
        for (int64_t c = 1; c <= j; c++) {
          LANES term = weighted[c];
          if (c < i) term *= U[BELOW(i, c)];
          within += term;
        }
        sums[i * n + j] += (LANES)(there & (MASKS)(m->weight[p] * (within + away[i] * away[j])));
      }
    }
  }
  for (int64_t i = 0; i < n; i++) {
    STORE(x_hat + i * trials, middle[i], w);
    for (int64_t j = 0; j <= i; j++) {
      STORE(P + (i * n + j) * trials, sums[i * n + j], w);
      if (j < i) STORE(P + (j * n + i) * trials, sums[i * n + j], w);
    }
  }
}

/* One slot. joint: [[L, 0], [gain, M]] of the slot, or NULL in slot 0. Returns the places that are in use afterwards. */
static inline __attribute__((always_inline)) int64_t NAME(mixture_slot, SET)(int64_t n, int64_t trials, int64_t w,
                                                                             int64_t capacity, int64_t places,
                                                                             const double *A, const double *joint,
                                                                             const double *rounding,
                                                                             double state_probability, const uint8_t *gamma,
                                                                             const double *z, double *x_hat, double *P,
                                                                             uint8_t *action, MIXTURES *m) {
  LANES none = {0.0}, one = NAME(splat, SET)(1.0), state, other = one, total = none;
  MASKS heard = LANES_WITH(gamma, w, 1);
  int some_heard = NAME(any, SET)(heard);
  for (int64_t i = 0; i < n; i++) m->z[i] = some_heard ? (LANES)(heard & (MASKS)LOAD(z + i * trials, w)) : none;
  if (joint) {
    LANES alone = none, ratios = none;
    if (some_heard) {
      for (int64_t i = 0; i < n; i++) {
        LANES rest = m->z[i];
        for (int64_t j = 0; j < i; j++) rest = rest - joint[2 * i * n + j] * m->white[j];
        m->white[i] = rest / joint[i * (2 * n + 1)];
        alone = i ? alone + m->white[i] * m->white[i] : m->white[i] * m->white[i];
      }
      for (int64_t i = 0; i < n; i++) {
        const double *gain = joint + 2 * (n + i) * n;
        LANES y = gain[0] * m->white[0];
        for (int64_t j = 1; j < n; j++) y += gain[j] * m->white[j];
        m->told[i] = (LANES)(heard & (MASKS)y);
      }
      NAME(factor_of, SET)(n, joint + 2 * n * n + n, 2 * n, m->known_unit, m->known);
    }
    for (int64_t p = 0; p < places; p++) {
      MASKS there = (MASKS)(m->weight[p] != none);
      if (NAME(any, SET)(there))
        ratios += NAME(component, SET)(n, A, joint, rounding, heard & there, alone, m->weight[p], m->mean + p * n,
                                       m->lower + p * BELOW(n, 0), m->diagonal + p * n, m);
    }
    if (state_probability == 1.0) {
      state = (LANES)(heard & (MASKS)one);
      other = one - state;
    } else {
      LANES odds = state_probability / (1.0 - state_probability) * ratios, sure = NAME(splat, SET)(SURE);
      odds = SELECT((MASKS)(odds > sure), sure, odds);
      state = (LANES)(heard & (MASKS)(odds / (1.0 + odds)));
      other = SELECT(heard, 1.0 / (1.0 + odds), one);
    }
    for (int64_t p = 0; p < places; p++) m->weight[p] = m->weight[p] * other;
  } else {
    state = (LANES)(heard & (MASKS)one);
    for (int64_t p = 0; p < places; p++) m->weight[p] = (LANES)(~heard & (MASKS)m->weight[p]);
  }
  LANES least = NAME(splat, SET)(NEGLIGIBLE);
  for (int64_t p = 0; p < places; p++) m->weight[p] = (LANES)((MASKS)(m->weight[p] > least) & (MASKS)m->weight[p]);
  MASKS waiting = (MASKS)(state > least);
  if (NAME(any, SET)(waiting)) {
    waiting = NAME(placed, SET)(n, capacity, waiting, state, m);
    if (NAME(any, SET)(waiting)) {
      NAME(merge, SET)(n, capacity, waiting, m);
      NAME(placed, SET)(n, capacity, waiting, state, m);
    }
    places = capacity;
  }
  for (int64_t p = 0; p < places; p++) total += m->weight[p];
  for (int64_t p = 0; p < places; p++)
    m->weight[p] = (LANES)((MASKS)(m->weight[p] != none) & (MASKS)(m->weight[p] / total));
  while (places && !NAME(any, SET)((MASKS)(m->weight[places - 1] != none))) places--;
  NAME(moments, SET)(n, places, trials, w, x_hat, P, m);
  MASKS certain = (MASKS)(state > NAME(splat, SET)(0.5));
  for (int64_t t = 0; t < WIDTH && t < w; t++) action[t] = heard[t] ? (certain[t] ? STATE : INNOVATION) : 0;
  return places;
}

static inline __attribute__((always_inline)) int64_t NAME(follow_mixture_of, SET)(
    int64_t slots, int64_t n, int64_t trials, int64_t before, int64_t capacity, int initial, const double *A, const double *G,
    const double *leaks, const double *rounding, double state_probability, const double *weight, const double *mean, const double *lower,
    const double *diagonal, const uint8_t *gamma, const double *z, double *x_hat, double *P, uint8_t *action,
    double *weight_after, double *mean_after, double *lower_after, double *diagonal_after, MIXTURES *m) {
  LANES none = {0.0};
  int64_t below = BELOW(n, 0), most = 0;
  for (int64_t i = 0; i < n * n; i++) m->A[i] = NAME(plain, SET)(A[i]);
  NAME(factor_of, SET)(n, G, n, m->noise_unit, m->noise);
  for (int64_t r = 0; r < trials; r += WIDTH) {
    int64_t w = trials - r, places = before;
    for (int64_t p = 0; p < before; p++) {
      m->weight[p] = LOAD(weight + p * trials + r, w);
      for (int64_t i = 0; i < n; i++) m->mean[p * n + i] = LOAD(mean + (i * before + p) * trials + r, w);
      for (int64_t i = 0; i < n; i++) m->diagonal[p * n + i] = LOAD(diagonal + (i * before + p) * trials + r, w);
      for (int64_t i = 0; i < below; i++) m->lower[p * below + i] = LOAD(lower + (i * before + p) * trials + r, w);
    }
    for (int64_t p = before; p < capacity; p++) m->weight[p] = none;
    for (int64_t s = 0; s < slots; s++)
      places = NAME(mixture_slot, SET)(n, trials, w, capacity, places, A, initial && s == 0 ? NULL : leaks + 4 * s * n * n, rounding + s * n,
                                       state_probability, gamma + s * trials + r, z + s * n * trials + r,
                                       x_hat + s * n * trials + r, P + s * n * n * trials + r, action + s * trials + r, m);
    for (int64_t p = 0; p < capacity; p++) {
      MASKS there = (MASKS)(m->weight[p] != none);
      STORE(weight_after + p * trials + r, m->weight[p], w);
      for (int64_t i = 0; i < n; i++)
        STORE(mean_after + (i * capacity + p) * trials + r, (LANES)(there & (MASKS)m->mean[p * n + i]), w);
      for (int64_t i = 0; i < n; i++)
        STORE(diagonal_after + (i * capacity + p) * trials + r, (LANES)(there & (MASKS)m->diagonal[p * n + i]), w);
      for (int64_t i = 0; i < below; i++)
        STORE(lower_after + (i * capacity + p) * trials + r, (LANES)(there & (MASKS)m->lower[p * below + i]), w);
    }
    if (places > most) most = places;
  }
  return most;
}

static int64_t NAME(follow_mixture, SET)(int64_t slots, int64_t n, int64_t trials, int64_t before, int64_t capacity, int initial,
                                         const double *A, const double *G, const double *leaks, const double *rounding, double state_probability,
                                         const double *weight, const double *mean, const double *lower,
                                         const double *diagonal, const uint8_t *gamma, const double *z, double *x_hat, double *P,
                                         uint8_t *action, double *weight_after, double *mean_after, double *lower_after,
                                         double *diagonal_after) {
  MIXTURES m = {0};
  int64_t places = NAME(new_mixture, SET)(n, capacity, &m);
  if (places == 0 && n == 2)
    places = NAME(follow_mixture_of, SET)(slots, 2, trials, before, capacity, initial, A, G, leaks, rounding, state_probability, weight,
                                          mean, lower, diagonal, gamma, z, x_hat, P, action, weight_after, mean_after,
                                          lower_after, diagonal_after, &m);
  else if (places == 0)
    places = NAME(follow_mixture_of, SET)(slots, n, trials, before, capacity, initial, A, G, leaks, rounding, state_probability, weight,
                                          mean, lower, diagonal, gamma, z, x_hat, P, action, weight_after, mean_after,
                                          lower_after, diagonal_after, &m);
  free(m.weight);
  free(m.A);
  return places;
}

#undef MIXTURES
#undef ENTRY
