/* Words to normal numbers: Wichura's algorithm AS 241 (PPND16) and the logarithm of FreeBSD's msun, as in elementary.py. */

#define TILE 256
#define POLYNOMIAL(c, x) \
  (((((((c[7] * (x) + c[6]) * (x) + c[5]) * (x) + c[4]) * (x) + c[3]) * (x) + c[2]) * (x) + c[1]) * (x) + c[0])

#ifndef QUANTILE_TABLES
#define QUANTILE_TABLES
static const double CENTRE[2][8] = {
    {3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3, 1.3731693765509461125e4,
     4.5921953931549871457e4, 6.7265770927008700853e4, 3.3430575583588128105e4, 2.5090809287301226727e3},
    {1.0, 4.2313330701600911252e1, 6.8718700749205790830e2, 5.3941960214247511077e3, 2.1213794301586595867e4,
     3.9307895800092710610e4, 2.8729085735721942674e4, 5.2264952788528545610e3}};
static const double TAIL[2][8] = {
    {1.42343711074968357734e0, 4.63033784615654529590e0, 5.76949722146069140550e0, 3.64784832476320460504e0,
     1.27045825245236838258e0, 2.41780725177450611770e-1, 2.27238449892691845833e-2, 7.74545014278341407640e-4},
    {1.0, 2.05319162663775882187e0, 1.67638483018380384940e0, 6.89767334985100004550e-1, 1.48103976427480074590e-1,
     1.51986665636164571966e-2, 5.47593808499534494600e-4, 1.05075007164441684324e-9}};
static const double FAR_TAIL[2][8] = {
    {6.65790464350110377720e0, 5.46378491116411436990e0, 1.78482653991729133580e0, 2.96560571828504891230e-1,
     2.65321895265761230930e-2, 1.24266094738807843860e-3, 2.71155556874348757815e-5, 2.01033439929228813265e-7},
    {1.0, 5.99832206555887937690e-1, 1.36929880922735805310e-1, 1.48753612908506148525e-2, 7.86869131145613259100e-4,
     1.84631831751005468180e-5, 1.42151175831644588870e-7, 2.04426310338993978564e-15}};
#endif

/* Natural logarithm of a positive, normal number. */
static inline __attribute__((always_inline)) double NAME(logarithm, SET)(double x) {
  int64_t bits, shifted;
  double mantissa, power;
  memcpy(&bits, &x, sizeof bits);
  int64_t exponent = (bits >> 52) - 1022;
  bits = (bits & 0x000fffffffffffff) | 0x3fe0000000000000;
  memcpy(&mantissa, &bits, sizeof mantissa);
  int small = mantissa < 0.7071067811865476;
  mantissa = small ? 2.0 * mantissa : mantissa;
  exponent = small ? exponent - 1 : exponent;
  shifted = exponent + 0x4338000000000000; /* a small integer as a double, exactly, without a conversion */
  memcpy(&power, &shifted, sizeof power);
  power -= 0x1.8p52;
  double f = mantissa - 1.0, s = f / (2.0 + f), z = s * s, w = z * z;
  double even = (1.531383769920937332e-01 * w + 2.222219843214978396e-01) * w + 3.999999999940941908e-01;
  double odd = ((1.479819860511658591e-01 * w + 1.818357216161805012e-01) * w + 2.857142874366239149e-01) * w +
               6.666666666666735130e-01;
  double tail = w * even + z * odd, half_square = 0.5 * f * f;
  return power * 6.93147180369123816490e-01 -
         ((half_square - (s * (half_square + tail) + power * 1.90821492927058770002e-10)) - f);
}

/* Normal quantiles of u (count,), 0 < u < 1, count <= TILE. */
static void NAME(quantiles, SET)(int64_t count, const double *restrict u, double *restrict out) {
  double outside[TILE], near_tail[TILE], size[TILE];
  int32_t which[TILE];
  for (int64_t i = 0; i < count; i++) {
    double q = u[i] - 0.5, r = 0.180625 - q * q;
    out[i] = POLYNOMIAL(CENTRE[0], r) / POLYNOMIAL(CENTRE[1], r) * q;
    outside[i] = r;
  }
  int64_t tails = 0;
  for (int64_t i = 0; i < count; i++) {
    which[tails] = (int32_t)i;
    tails += outside[i] < 0.0;
  }
  for (int64_t t = 0; t < tails; t++) {
    double one = u[which[t]];
    near_tail[t] = one > 0.5 ? 1.0 - one : one;
  }
  for (int64_t t = 0; t < tails; t++) {
    double root = sqrt(-NAME(logarithm, SET)(near_tail[t])), r = root - 1.6;
    near_tail[t] = root;
    size[t] = POLYNOMIAL(TAIL[0], r) / POLYNOMIAL(TAIL[1], r);
  }
  for (int64_t t = 0; t < tails; t++) {
    if (near_tail[t] > 5.0) {
      double r = near_tail[t] - 5.0;
      size[t] = POLYNOMIAL(FAR_TAIL[0], r) / POLYNOMIAL(FAR_TAIL[1], r);
    }
    out[which[t]] = u[which[t]] > 0.5 ? size[t] : -size[t];
  }
}

static void NAME(normals, SET)(int64_t rows, int64_t trials, int64_t stride, int64_t width, const uint64_t *words,
                               double *out) {
  double u[TILE];
  for (int64_t s = 0; s < rows; s++)
    for (int64_t j = 0; j < width; j++)
      for (int64_t start = 0; start < trials; start += TILE) {
        int64_t count = trials - start < TILE ? trials - start : TILE;
        const uint64_t *from = words + (s * trials + start) * stride + j;
        for (int64_t r = 0; r < count; r++) {
          /* The upper 52 bits as a double: below 2^52, exactly, without a conversion. */
          uint64_t bits = from[r * stride] >> 12 | 0x4330000000000000;
          double number;
          memcpy(&number, &bits, sizeof number);
          u[r] = ((number - 0x1p52) + 0.5) * 0x1p-52;
        }
        NAME(quantiles, SET)(count, u, out + (s * width + j) * trials + start);
      }
}
#undef TILE
#undef POLYNOMIAL
