/* What the kernels offer. cffi reads this file as it is, so it has declarations only. Arrays are contiguous, trials last. */

/* The instruction sets that this build knows and this processor has, as the highest number for kernels_use; 0 is the baseline. */
int kernels_best(void);
void kernels_use(int set);

/* AES counters (slots, count): slot and number of the block, both big-endian. */
void kernels_counters(int64_t slots, int64_t count, uint64_t slot, uint64_t first, uint64_t *out);

/* words (rows, trials, stride) to numbers (rows, width, trials), width <= stride. */
void kernels_uniforms(int64_t rows, int64_t trials, int64_t stride, int64_t width, const uint64_t *words, double *out);
void kernels_normals(int64_t rows, int64_t trials, int64_t stride, int64_t width, const uint64_t *words, double *out);

/* M (rows, m, n) times x (rows, n, trials): out (rows, m, trials). */
void kernels_product(int64_t rows, int64_t m, int64_t n, int64_t trials, const double *M, const double *x, double *out);

/* States of consecutive slots: predicted = A x before, x = predicted + noise; (slots, n, trials), before (n, trials). */
void kernels_advance(int64_t slots, int64_t n, int64_t trials, const double *A, const double *noise, const double *before,
                     double *predicted, double *x);

/* z = nu ? (x - predicted) + chi : x; nu (slots, trials), the others (slots, n, trials). */
void kernels_encode(int64_t slots, int64_t n, int64_t trials, const uint8_t *nu, const double *x, const double *predicted,
                    const double *chi, double *z);

/* Beliefs after consecutive slots; initial: the first of them is not predicted. x_hat, z and new_x may be NULL together, and
   chi alone. Returns 0, or -1 where memory is short. */
int kernels_follow(int64_t slots, int64_t n, int64_t trials, int initial, const double *A, const double *Q,
                   const double *x_hat, const double *P, const uint8_t *action, const double *z, const double *chi,
                   double *new_x, double *new_P);

/* Bytes to digest of trials first ... first + count - 1, out (count, slots, 1 + 8 (width + n (n + 1) / 2)): of each slot a mark
   that is 0 or 1, then the numbers of a (slots, width, trials), and the upper triangle of P (slots, n, n, trials), row by row. P
   may be NULL where n is 0. */
void kernels_records(int64_t slots, int64_t trials, int64_t first, int64_t count, const uint8_t *marks, int64_t width,
                     const double *a, int64_t n, const double *P, uint8_t *out);

/* |x - x_hat|^2, (slots, trials), from (slots, n, trials). */
void kernels_squared_errors(int64_t slots, int64_t n, int64_t trials, const double *x, const double *x_hat, double *out);

/* tr P, (slots, trials), from (slots, n, n, trials). */
void kernels_traces(int64_t slots, int64_t n, int64_t trials, const double *P, double *out);

/* Sums over trials of values (slots, trials), and of their squares, (slots, 2). */
void kernels_sums(int64_t slots, int64_t trials, const double *values, double *out);

/* Slot by slot: what total (trials,) grew by since mark (trials,) is added to mark, and its square to squares (trials,), where
   state (slots, trials) is 1; then traces (slots, trials) is added to total. */
void kernels_add_between(int64_t slots, int64_t trials, const uint8_t *state, const double *traces, double *total,
                         double *mark, double *squares);

/* Slot by slot, where heard (slots, trials) is 1: adds by_type (slots, 2), at the column nu (slots, trials), to bits (trials,), or 1
   to clear (trials,) where that is infinite. */
void kernels_add_leaked(int64_t slots, int64_t trials, const uint8_t *heard, const uint8_t *nu, const double *by_type,
                        double *bits, double *clear);

/* Adds to counts (slots, kinds) how often each code below `kinds` occurs in each slot, from codes (slots, trials). */
void kernels_count_codes(int64_t slots, int64_t trials, const uint8_t *codes, int64_t kinds, uint32_t *counts);

/* Lengths of runs of `lost` that another code ends, 1, 2, ..., added to counts (most,), those of `most` and more together;
   run (trials,): the length of each trial's current run, before and after. */
void kernels_bursts(int64_t slots, int64_t trials, const uint8_t *codes, uint8_t lost, int64_t *run, int64_t most,
                    uint32_t *counts);

/* Adds to counts (rows, bins) the bin of each value (rows, trials): its bits shifted right, less base, within 0 ... bins - 1. */
void kernels_histogram(int64_t rows, int64_t trials, const double *values, int shift, int64_t base, int64_t bins,
                       uint32_t *counts);

/* z (slots, n, trials) from the packed numbers of the flagged trials: for each slot n rows of as many numbers as flags (slots,
   trials); 0 elsewhere. */
void kernels_scatter(int64_t slots, int64_t n, int64_t trials, const uint8_t *flags, const double *packed, double *z);

/* The numbers of x (slots, n, trials) in the flagged trials, flags (slots, trials), as kernels_scatter takes them. */
void kernels_gather(int64_t slots, int64_t n, int64_t trials, const uint8_t *flags, const double *x, double *out);

/* Each of M (count, n, m), m >= n, turned by Givens rotations until it is lower triangular with a non-negative diagonal, in place.
   Returns 0, or -1 where memory is short. */
int kernels_triangularise(int64_t count, int64_t n, int64_t m, double *M);

/* A L after each of `slots` slots, out (slots, n, n), where L is the triangular factor of [carried, G], and carried the A L before;
   all (n, n). Returns what kernels_triangularise does. */
int kernels_carried_factors(int64_t n, int64_t slots, const double *A, const double *G, const double *carried, double *out);

/* The Bayesian eavesdropper in consecutive slots; initial: the first of them is slot 0. A and G (n, n), leaks (slots, 2n, 2n),
   gamma (slots, trials), z (slots, n, trials). The mixture before has `before` <= capacity places: weight (before, trials), mean
   and diagonal (n, before, trials), lower (n (n-1)/2, before, trials); the one after has `capacity` places in the same order.
   x_hat (slots, n, trials), P (slots, n, n, trials) and action (slots, trials) are those after each slot. Returns how many places
   are in use, or -1 where memory is short. */
int64_t kernels_follow_mixture(int64_t slots, int64_t n, int64_t trials, int64_t before, int64_t capacity, int initial,
                               const double *A, const double *G, const double *leaks, const double *rounding,
                               double state_probability, const double *weight, const double *mean, const double *lower, const double *diagonal,
                               const uint8_t *gamma, const double *z, double *x_hat, double *P, uint8_t *action,
                               double *weight_after, double *mean_after, double *lower_after, double *diagonal_after);
