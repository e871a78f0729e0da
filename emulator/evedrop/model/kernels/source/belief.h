/* Beliefs and triangular factors. */

#ifndef ACTIONS
#define ACTIONS
#define SMALL 0x1p-485 /* below it squares lose digits to underflow */
#define SCALE 0x1p600
enum { STATE = 1, INNOVATION = 2 }; /* `Action` of model/receiver.py */
#define CACHED 2048                 /* numbers of a covariance's rows that stay in the nearest cache */
#define GROUP 4                     /* rows or columns computed at once, so that a loaded number serves several sums */
#endif

/* A P A' of WIDTH trials, (n, n) each, into `left` and then into `out`. */
static inline __attribute__((always_inline)) void NAME(carry, SET)(int64_t n, const double *A, const LANES *P, LANES *left,
                                                                   LANES *out) {
  int64_t i = 0;
  for (; i + GROUP <= n; i += GROUP)
    for (int64_t c = 0; c < n; c++) {
      LANES sum[GROUP], one = P[c];
      for (int g = 0; g < GROUP; g++) sum[g] = A[(i + g) * n] * one;
      for (int64_t j = 1; j < n; j++) {
        one = P[j * n + c];
        for (int g = 0; g < GROUP; g++) sum[g] += A[(i + g) * n + j] * one;
      }
      for (int g = 0; g < GROUP; g++) left[(i + g) * n + c] = sum[g];
    }
  for (; i < n; i++)
    for (int64_t c = 0; c < n; c++) {
      LANES sum = A[i * n] * P[c];
      for (int64_t j = 1; j < n; j++) sum += A[i * n + j] * P[j * n + c];
      left[i * n + c] = sum;
    }
  int64_t c = 0;
  for (; c + GROUP <= n; c += GROUP)
    for (i = 0; i < n; i++) {
      LANES sum[GROUP], one = left[i * n];
      for (int g = 0; g < GROUP; g++) sum[g] = one * A[(c + g) * n];
      for (int64_t j = 1; j < n; j++) {
        one = left[i * n + j];
        for (int g = 0; g < GROUP; g++) sum[g] += one * A[(c + g) * n + j];
      }
      for (int g = 0; g < GROUP; g++) out[i * n + c + g] = sum[g];
    }
  for (; c < n; c++)
    for (i = 0; i < n; i++) {
      LANES sum = left[i * n] * A[c * n];
      for (int64_t j = 1; j < n; j++) sum += left[i * n + j] * A[c * n + j];
      out[i * n + c] = sum;
    }
}

/* One slot of up to WIDTH trials; `held`, `left` and `carried` are work space. */
static inline __attribute__((always_inline)) void NAME(step, SET)(int64_t n, int64_t trials, int64_t w, int initial,
                                                                  const double *A, const double *Q, const double *x_hat,
                                                                  const double *P, const uint8_t *action, const double *z,
                                                                  const double *chi, double *new_x, double *new_P,
                                                                  LANES *work) {
  LANES *held = work, *left = work + n * n, *carried = work + 2 * n * n;
  MASKS state = LANES_WITH(action, w, STATE), innovation = LANES_WITH(action, w, INNOVATION);
  if (x_hat)
    for (int64_t i = 0; i < n; i++) {
      LANES value;
      if (initial) {
        value = LOAD(x_hat + i * trials, w);
      } else {
        value = A[i * n] * LOAD(x_hat, w);
        for (int64_t j = 1; j < n; j++) value += A[i * n + j] * LOAD(x_hat + j * trials, w);
      }
      LANES packet = LOAD(z + i * trials, w);
      if (chi) value = SELECT(innovation, value + (packet - LOAD(chi + i * trials, w)), value);
      STORE(new_x + i * trials, SELECT(state, packet, value), w);
    }
  for (int64_t i = 0; i < n * n; i++) held[i] = LOAD(P + i * trials, w);
  if (!initial) NAME(carry, SET)(n, A, held, left, carried);
  for (int64_t i = 0; i < n * n; i++) {
    LANES value = initial ? held[i] : SELECT(innovation, carried[i], carried[i] + Q[i]);
    STORE(new_P + i * trials, (LANES)(~state & (MASKS)value), w);
  }
}

/* The same for many slots, some trials at a time, so that what a slot needs of the slot before is still in the cache. */
static inline __attribute__((always_inline)) void NAME(follow_of, SET)(int64_t slots, int64_t n, int64_t trials, int initial,
                                                                       const double *A, const double *Q, const double *x_hat,
                                                                       const double *P, const uint8_t *action,
                                                                       const double *z, const double *chi, double *new_x,
                                                                       double *new_P, LANES *work) {
  int64_t size = n * trials, some = CACHED / (n * n) / WIDTH * WIDTH;
  if (some < WIDTH) some = WIDTH;
  for (int64_t start = 0; start < trials; start += some) {
    int64_t end = start + some < trials ? start + some : trials;
    for (int64_t s = 0; s < slots; s++) {
      const double *x_before = s ? new_x + (s - 1) * size : x_hat, *P_before = s ? new_P + (s - 1) * n * size : P;
      for (int64_t r = start; r < end; r += WIDTH)
        NAME(step, SET)(n, trials, end - r, initial && s == 0, A, Q, x_hat ? x_before + r : NULL, P_before + r,
                        action + s * trials + r, z ? z + s * size + r : NULL, chi ? chi + s * size + r : NULL,
                        new_x ? new_x + s * size + r : NULL, new_P + s * n * size + r, work);
    }
  }
}

/* A few trials of many states, one after the other: rows of a covariance fill the registers instead of trials. `work` has three
   matrices; `turned` is A'. */
static void NAME(follow_alone, SET)(int64_t slots, int64_t n, int64_t trials, int initial, const double *A, const double *Q,
                                    const double *x_hat, const double *P, const uint8_t *action, const double *z,
                                    const double *chi, double *new_x, double *new_P, double *work) {
  double *restrict held = work, *restrict left = work + n * n, *restrict turned = work + 2 * n * n;
  for (int64_t i = 0; i < n; i++)
    for (int64_t j = 0; j < n; j++) turned[j * n + i] = A[i * n + j];
  for (int64_t s = 0; s < slots; s++) {
    for (int64_t r = 0; r < trials; r++) {
      int first = initial && s == 0, state = action[r] == STATE, innovation = action[r] == INNOVATION;
      for (int64_t i = 0; x_hat && i < n; i++) {
        double value = x_hat[i * trials + r], packet = z[i * trials + r];
        if (!first) {
          value = A[i * n] * x_hat[r];
          for (int64_t j = 1; j < n; j++) value += A[i * n + j] * x_hat[j * trials + r];
        }
        if (chi && innovation) value = value + (packet - chi[i * trials + r]);
        new_x[i * trials + r] = state ? packet : value;
      }
      for (int64_t i = 0; i < n * n; i++) held[i] = P[i * trials + r];
      if (!first && !state) {
        for (int64_t i = 0; i < n; i++) {
          double *restrict row = left + i * n;
          for (int64_t c = 0; c < n; c++) row[c] = A[i * n] * held[c];
          for (int64_t j = 1; j < n; j++)
            for (int64_t c = 0; c < n; c++) row[c] += A[i * n + j] * held[j * n + c];
        }
        for (int64_t i = 0; i < n; i++) {
          double *restrict row = held + i * n;
          for (int64_t c = 0; c < n; c++) row[c] = left[i * n] * turned[c];
          for (int64_t j = 1; j < n; j++)
            for (int64_t c = 0; c < n; c++) row[c] += left[i * n + j] * turned[j * n + c];
          for (int64_t c = 0; c < n && !innovation; c++) row[c] += Q[i * n + c];
        }
      }
      for (int64_t i = 0; i < n * n; i++) new_P[i * trials + r] = state ? 0.0 : held[i];
    }
    P = new_P;
    new_P += n * n * trials;
    action += trials;
    if (x_hat) {
      x_hat = new_x;
      new_x += n * trials;
      z += n * trials;
      if (chi) chi += n * trials;
    }
  }
}

static int NAME(follow, SET)(int64_t slots, int64_t n, int64_t trials, int initial, const double *A, const double *Q,
                             const double *x_hat, const double *P, const uint8_t *action, const double *z, const double *chi,
                             double *new_x, double *new_P) {
  if (n == 2) {
    LANES work[12] = {{0.0}};
    NAME(follow_of, SET)(slots, 2, trials, initial, A, Q, x_hat, P, action, z, chi, new_x, new_P, work);
    return 0;
  }
  LANES *work = malloc((size_t)(3 * n * n) * sizeof *work);
  if (!work) return -1;
  if (2 * trials < WIDTH && n > 2)
    NAME(follow_alone, SET)(slots, n, trials, initial, A, Q, x_hat, P, action, z, chi, new_x, new_P, (double *)work);
  else
    NAME(follow_of, SET)(slots, n, trials, initial, A, Q, x_hat, P, action, z, chi, new_x, new_P, work);
  free(work);
  return 0;
}

/* Works on the columns of M, which a rotation mixes in pairs, as rows. */
static int NAME(triangularise, SET)(int64_t n, int64_t m, double *M) {
  double *work = malloc((size_t)(n * m > 0 ? n * m : 1) * sizeof *work);
  if (!work) return -1;
  for (int64_t i = 0; i < n; i++)
    for (int64_t j = 0; j < m; j++) work[j * n + i] = M[i * m + j];
  for (int64_t i = 0; i < n; i++) {
    double *restrict pivot = work + i * n;
    for (int64_t j = i + 1; j < m; j++) {
      double *restrict other = work + j * n;
      double b = other[i];
      if (b == 0.0) continue;
      double a = pivot[i], r = sqrt(a * a + b * b), scale = r < SMALL ? SCALE : 1.0;
      if (scale != 1.0) {
        a *= scale;
        b *= scale;
        r = sqrt(a * a + b * b);
      }
      double cosine = a / r, sine = b / r;
      pivot[i] = r / scale;
      other[i] = 0.0;
      for (int64_t q = i + 1; q < n; q++) {
        double left = pivot[q], right = other[q];
        pivot[q] = cosine * left + sine * right;
        other[q] = cosine * right - sine * left;
      }
    }
    if (pivot[i] < 0.0)
      for (int64_t q = i; q < n; q++) pivot[q] = -pivot[q];
  }
  for (int64_t i = 0; i < n; i++)
    for (int64_t j = 0; j < m; j++) M[i * m + j] = work[j * n + i];
  free(work);
  return 0;
}

static int NAME(carried_factors, SET)(int64_t n, int64_t slots, const double *A, const double *G, const double *carried,
                                      double *out) {
  double *joint = malloc((size_t)(2 * n * n) * sizeof *joint);
  if (!joint) return -1;
  int failed = 0;
  for (int64_t s = 0; s < slots && !failed; s++, carried = out, out += n * n) {
    for (int64_t i = 0; i < n; i++) {
      memcpy(joint + 2 * i * n, carried + i * n, (size_t)n * sizeof *joint);
      memcpy(joint + (2 * i + 1) * n, G + i * n, (size_t)n * sizeof *joint);
    }
    failed = NAME(triangularise, SET)(n, 2 * n, joint);
    for (int64_t i = 0; i < n; i++)
      for (int64_t c = 0; c < n; c++) {
        double y = A[i * n] * joint[c];
        for (int64_t j = 1; j < n; j++) y += A[i * n + j] * joint[2 * j * n + c];
        out[i * n + c] = y;
      }
  }
  free(joint);
  return failed;
}
