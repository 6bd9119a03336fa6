/* The number as 32-bit fixed point; see control/scalar.h.
 *
 * Scaling and overflow. A scalar has 24 fraction bits, a gain 18, a variance 30. Products are formed in 64 bits and
 * rounded half up, quotients and roots are cut off; both saturate at a quarter of the range, +-32 for a scalar: so
 * the sum of four of them, written with a plain +, cannot overflow, and a value at its limit stays there instead of
 * turning its sign. Longer sums and sums over time go through add_limited. A small factor is multiplied first,
 * amp(k, mul(small, x)), so that the limit is not met on the way. Right shifts of negative numbers are arithmetic, as on every compiler this is built with (asserted). */
#ifndef CONTROL_SCALAR_FIXED_H
#define CONTROL_SCALAR_FIXED_H

#include <stdbool.h>
#include <stdint.h>

typedef int32_t scalar;   /* Q7.24 */
typedef int32_t gain;     /* Q13.18 */
typedef int32_t variance; /* Q1.30 */

/* 1 / v = mantissa * 2^(shift - 32), normalised. */
typedef struct {
    int32_t mantissa;
    uint8_t shift;
} inverse;

#define SCALAR_NAME "fixed"
#define SCALAR_FRACTION 24
#define GAIN_FRACTION 18
#define VARIANCE_FRACTION 30
#define FIXED_LIMIT (((int32_t)1 << 29) - 1)

_Static_assert((-3 >> 1) == -2, "right shifts of negative numbers must be arithmetic");

#define FIXED_CONSTANT(real, one) ((int32_t)((real) * (one) + ((real) < 0 ? -0.5 : 0.5)))
#define SCALAR(real) FIXED_CONSTANT(real, 16777216.0)
#define GAIN(real) FIXED_CONSTANT(real, 262144.0)
#define VARIANCE(real) FIXED_CONSTANT(real, 1073741824.0)

static inline int32_t fixed_limited(int64_t x, int32_t most)
{
    if (x > most) {
        return most;
    }
    return x < -most ? -most : (int32_t)x;
}

static inline int32_t fixed_saturate(int64_t x)
{
    return fixed_limited(x, FIXED_LIMIT);
}

static inline int32_t fixed_product(int32_t a, int32_t b, uint8_t shift)
{
    return fixed_saturate(((int64_t)a * b + ((int64_t)1 << (shift - 1))) >> shift);
}

/* a / b * 2^shift, limited to -most..most; anything over 0 is at the limit. */
int32_t fixed_quotient(int32_t a, int32_t b, uint8_t shift, int32_t most);

static inline scalar mul(scalar a, scalar b)
{
    return fixed_product(a, b, SCALAR_FRACTION);
}

static inline scalar amp(gain k, scalar x)
{
    return fixed_product(k, x, GAIN_FRACTION);
}

static inline scalar quot(scalar a, scalar b)
{
    return fixed_quotient(a, b, SCALAR_FRACTION, FIXED_LIMIT);
}

/* A gain is no term of a sum: it may use the whole word. */
static inline gain gain_quot(scalar a, scalar b)
{
    return fixed_quotient(a, b, GAIN_FRACTION, INT32_MAX);
}

static inline gain gain_part(gain k, uint32_t parts)
{
    return fixed_quotient(k, (int32_t)parts, 0, INT32_MAX);
}

/* Sums that may grow without end stop at the word's. */
static inline scalar add_limited(scalar a, scalar b)
{
    return fixed_limited((int64_t)a + b, INT32_MAX);
}

static inline variance add_variance(variance a, variance b)
{
    return fixed_limited((int64_t)a + b, INT32_MAX);
}

/* part / whole of two counts, part <= whole < 2^31. */
scalar fraction(uint32_t part, uint32_t whole);

scalar root(scalar x);

/* sd^2 for |sd| <= 1. */
static inline variance variance_of(scalar sd)
{
    const uint8_t shift = 2 * SCALAR_FRACTION - VARIANCE_FRACTION;
    return fixed_limited(((int64_t)sd * sd + ((int64_t)1 << (shift - 1))) >> shift, INT32_MAX);
}

scalar sd_of(variance v);

static inline variance scale_variance(variance v, scalar f)
{
    return fixed_limited(((int64_t)v * f + ((int64_t)1 << (SCALAR_FRACTION - 1))) >> SCALAR_FRACTION,
                         INT32_MAX);
}

/* v > 0. */
inverse invert(variance v);

/* v times an inverse: as a gain, because small over smaller can be large, and as a share, for ratios up to 1. */
static inline gain variance_ratio(variance v, inverse i)
{
    return fixed_product(v, i.mantissa, (uint8_t)(62 - GAIN_FRACTION - i.shift));
}

static inline scalar variance_share(variance v, inverse i)
{
    return fixed_product(v, i.mantissa, (uint8_t)(62 - SCALAR_FRACTION - i.shift));
}

#endif
