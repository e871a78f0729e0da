/* Covariances as U D U', WIDTH of them at a time: each function does what its namesake in factored.py does. */

#ifndef FACTORED
#define FACTORED
enum { NOUGHT, UNIT, PLAIN, VARIED }; /* an entry is 0, 1 or another number in all matrices, or differs between them */
#define BELOW(i, j) ((i) * ((i) - 1) / 2 + (j))
#endif

typedef struct {
  LANES value;
  int64_t kind;
} NAME(entry, SET);
#define ENTRY NAME(entry, SET)

static inline __attribute__((always_inline)) LANES NAME(splat, SET)(double value) {
  LANES none = {0.0};
  return value - none; /* -0.0 stays what it is */
}

/* The same number in all matrices. */
static inline __attribute__((always_inline)) ENTRY NAME(plain, SET)(double value) {
  ENTRY entry = {NAME(splat, SET)(value), value == 0.0 ? NOUGHT : value == 1.0 ? UNIT : PLAIN};
  return entry;
}

static inline __attribute__((always_inline)) ENTRY NAME(varied, SET)(LANES value) {
  ENTRY entry = {value, VARIED};
  return entry;
}

static inline __attribute__((always_inline)) ENTRY NAME(times, SET)(ENTRY a, ENTRY b) {
  if (a.kind == UNIT) return b;
  if (a.kind == NOUGHT || b.kind == NOUGHT) return NAME(plain, SET)(0.0);
  if (b.kind == UNIT) return a;
  if (a.kind != VARIED && b.kind != VARIED) return NAME(plain, SET)(a.value[0] * b.value[0]);
  return NAME(varied, SET)(a.value * b.value);
}

static inline __attribute__((always_inline)) ENTRY NAME(plus, SET)(ENTRY total, ENTRY term) {
  if (total.kind != VARIED && term.kind != VARIED) return NAME(plain, SET)(total.value[0] + term.value[0]);
  return NAME(varied, SET)(total.value + term.value);
}

static inline __attribute__((always_inline)) ENTRY NAME(dot, SET)(int64_t count, const ENTRY *left, const ENTRY *right) {
  ENTRY total = NAME(plain, SET)(0.0);
  for (int64_t c = 0; c < count; c++) {
    ENTRY term = NAME(times, SET)(left[c], right[c]);
    if (total.kind == NOUGHT)
      total = term;
    else if (term.kind != NOUGHT)
      total = NAME(plus, SET)(total, term);
  }
  return total;
}

/* Factors of W diag(weights) W' from the rows of W, (n, m), which change; `first`: the products of the first row, or NULL. */
static __attribute__((noinline)) void NAME(orthogonalised, SET)(int64_t n, int64_t m, ENTRY *rows,
                                                                            const ENTRY *weights, const ENTRY *first,
                                                                            ENTRY *weighted, LANES *lower, LANES *diagonal) {
  LANES none = {0.0};
  for (int64_t i = 0; i < n; i++) {
    ENTRY *own = rows + i * m;
    int known = first && i == 0;
    for (int64_t c = 0; c < m && !known; c++) weighted[c] = NAME(times, SET)(weights[c], own[c]);
    LANES length = (known ? first[0] : NAME(dot, SET)(m, weighted, own)).value;
    MASKS some = (MASKS)(length > none);
    diagonal[i] = length;
    for (int64_t j = i + 1; j < n; j++) {
      ENTRY *row = rows + j * m;
      LANES along = (known ? first[j] : NAME(dot, SET)(m, weighted, row)).value, share = (LANES)(some & (MASKS)(along / length));
      lower[BELOW(j, i)] = share;
      for (int64_t c = 0; c < m; c++)
        if (own[c].kind != NOUGHT)
          row[c] = NAME(varied, SET)(row[c].value - share * own[c].value);
    }
  }
}

/* The factor of L L', L (n, n) lower triangular in rows of `stride` numbers, as it is needed below: U, and D. */
static __attribute__((noinline)) void NAME(factor_of, SET)(int64_t n, const double *L, int64_t stride, ENTRY *unit,
                                                                       ENTRY *diagonal) {
  for (int64_t i = 0; i < n; i++) {
    for (int64_t j = 0; j < n; j++) {
      double pivot = L[j * stride + j];
      unit[i * n + j] = NAME(plain, SET)(j < i ? (pivot > 0.0 ? L[i * stride + j] / pivot : 0.0) : j == i ? 1.0 : 0.0);
    }
    diagonal[i] = NAME(plain, SET)(L[i * stride + i] * L[i * stride + i]);
  }
}

/* The rows of A U, (n, n), and the products of the first with all, weighted by D. */
static __attribute__((noinline)) void NAME(carried_rows, SET)(int64_t n, const ENTRY *A, const LANES *lower,
                                                                          const LANES *diagonal, ENTRY *carried,
                                                                          ENTRY *products, ENTRY *weighted) {
  for (int64_t i = 0; i < n; i++)
    for (int64_t j = 0; j < n; j++) {
      ENTRY total = NAME(times, SET)(A[i * n + j], NAME(plain, SET)(1.0)); /* what is above U's diagonal is 0 */
      for (int64_t r = j + 1; r < n; r++) {
        ENTRY term = NAME(times, SET)(A[i * n + r], NAME(varied, SET)(lower[BELOW(r, j)]));
        if (total.kind == NOUGHT)
          total = term;
        else if (term.kind != NOUGHT)
          total = NAME(plus, SET)(total, term);
      }
      carried[i * n + j] = total;
    }
  for (int64_t j = 0; j < n; j++) weighted[j] = NAME(times, SET)(NAME(varied, SET)(diagonal[j]), carried[j]);
  for (int64_t i = 0; i < n; i++) products[i] = NAME(dot, SET)(n, weighted, carried + i * n);
}

/* Factors of A P A' + noise, from `carried_rows`; `rows` (n, 2n), `weights` and `weighted` (2n,), `first` (n,) are work space. */
static __attribute__((noinline)) void NAME(grown, SET)(int64_t n, const ENTRY *carried, const ENTRY *products,
                                                                   const LANES *P_diagonal, const ENTRY *unit,
                                                                   const ENTRY *noise, ENTRY *rows, ENTRY *weights,
                                                                   ENTRY *weighted, ENTRY *first, LANES *lower,
                                                                   LANES *diagonal) {
  for (int64_t i = 0; i < n; i++) {
    for (int64_t j = 0; j < n; j++) {
      rows[2 * i * n + j] = carried[i * n + j];
      rows[(2 * i + 1) * n + j] = unit[i * n + j];
    }
    first[i] = NAME(plus, SET)(products[i], NAME(plain, SET)(noise[0].value[0] * unit[i * n].value[0]));
    weights[i] = NAME(varied, SET)(P_diagonal[i]);
    weights[n + i] = noise[i];
  }
  NAME(orthogonalised, SET)(n, 2 * n, rows, weights, first, weighted, lower, diagonal);
}

/* d' P^-1 d; `e` (n,) is work space. */
static inline __attribute__((always_inline)) LANES NAME(squared_length, SET)(int64_t n, const LANES *lower,
                                                                             const LANES *diagonal, const LANES *d, LANES *e) {
  LANES total = {0.0};
  for (int64_t i = 0; i < n; i++) {
    LANES rest = d[i];
    for (int64_t j = 0; j < i; j++) rest = rest - lower[BELOW(i, j)] * e[j];
    e[i] = rest;
    total = total + rest * rest / diagonal[i];
  }
  return total;
}
