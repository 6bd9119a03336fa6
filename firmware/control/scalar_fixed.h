/* The number as 32-bit fixed point; see control/scalar.h.
 *
 * Scaling and overflow. A scalar has 24 fraction bits, a gain 18, a variance 30. Products are formed in 64 bits and
 * rounded half up, quotients and roots are cut off; both saturate at a quarter of the range, +-32 for a scalar: so
 * the sum of four of them, written with a plain +, cannot overflow, and a value at its limit stays there instead of
 * turning its sign. It is the product's high word that is limited, one instruction: at the limit, what the low word
 * leaves below it is arbitrary, 2^-11 of the limit at most. Longer sums and sums over time go through add_limited, or
 * are sums of products in 64 bits, rounded and limited once. A small factor is multiplied first, amp(k, mul(small, x)),
 * so that the limit is not met on the way. Right shifts of negative numbers are arithmetic, as on every compiler this
 * is built with (asserted). */
#ifndef CONTROL_SCALAR_FIXED_H
#define CONTROL_SCALAR_FIXED_H

#include <stdbool.h>
#include <stdint.h>

/* Before loops of a few passes: there are no registers for a row of numbers, and code takes flash. */
#define UNROLL_SHORT_LOOP

typedef int32_t scalar;   /* Q7.24 */
typedef int32_t gain;     /* Q13.18 */
typedef int32_t variance; /* Q1.30 */

typedef int64_t wide; /* Q15.48 */

/* 1 / v = mantissa * 2^(shift - 32), normalised; of more shift its product with any variance is at the limit. */
#define INVERSE_SHIFT_MOST 34
typedef struct {
    int32_t mantissa;
    int8_t shift;
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

/* x limited to words of so many bits with their sign; bits must be a constant. Arm has an instruction for it, which
 * compilers only find in the simplest places. */
#if defined(__ARM_FEATURE_SAT)
#define FIXED_WORD(x, bits) ((int32_t)__builtin_arm_ssat((x), (bits)))
#else
#define FIXED_WORD(x, bits) limit_word((x), ((int32_t)1 << ((bits)-1)) - 1)
static inline int32_t limit_word(int32_t x, int32_t most)
{
    if (x > most) {
        return most;
    }
    return x < -most - 1 ? -most - 1 : x;
}
#endif

/* x * 2^-shift, rounded half up, for constants 2 < shift < 32 and |x| < 2^62; limited to -2^whole..2^whole - 1, whole
 * < 32. */
#define FIXED_ROUNDED(x, shift, whole)                                                                  \
    fixed_words(FIXED_WORD((int32_t)(((x) + ((int64_t)1 << ((shift)-1))) >> 32), (shift) + (whole)-31), \
                (uint32_t)((x) + ((int64_t)1 << ((shift)-1))), (shift))

static inline int32_t fixed_words(int32_t high, uint32_t low, uint8_t shift)
{
    return (int32_t)((uint32_t)high << (32 - shift) | low >> shift);
}

/* The same of a shift that is not known beforehand, 0 < shift < 63. */
static inline int32_t fixed_shifted(int64_t x, uint8_t shift)
{
    return fixed_saturate((x + ((int64_t)1 << (shift - 1))) >> shift);
}

/* v * mantissa * 2^-shift, 3 < shift < 63, limited: what shifts past 31 bits is taken off the mantissa, half a step of the
 * result at most. Of one mantissa and many v all but a few instructions are the same. */
static inline int32_t fixed_scaled(int32_t v, int32_t mantissa, int32_t shift)
{
    const int32_t off = shift > 31 ? shift - 31 : 0;
    const int32_t factor = off > 0 ? ((mantissa >> (off - 1)) + 1) >> 1 : mantissa;
    const int32_t rest = shift - off;
    const int64_t x = (int64_t)v * factor + (int64_t)((uint32_t)1 << (rest - 1)); /* rest is 31 at most */
    const int32_t high = (int32_t)(x >> 32);
    const uint32_t most = (uint32_t)1 << (rest - 3);
    if ((uint32_t)high + most >= 2u * most) {
        return high < 0 ? -FIXED_LIMIT : FIXED_LIMIT;
    }
    return (int32_t)((uint32_t)high << (32 - rest) | (uint32_t)x >> rest);
}

/* a / b * 2^shift, cut off, limited to -most..most; anything over 0 is at the limit. */
int32_t fixed_quotient(int32_t a, int32_t b, uint8_t shift, int32_t most);

static inline scalar absolute(scalar x)
{
    return x < 0 ? -x : x;
}

static inline scalar mul(scalar a, scalar b)
{
    const int64_t product = (int64_t)a * b;
    return FIXED_ROUNDED(product, SCALAR_FRACTION, 29);
}

static inline scalar amp(gain k, scalar x)
{
    const int64_t product = (int64_t)k * x;
    return FIXED_ROUNDED(product, GAIN_FRACTION, 29);
}

/* Through the divisor's inverse: to a step and a part in 2^29. */
scalar quot(scalar a, scalar b);

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
    int32_t sum;
    if (__builtin_add_overflow(a, b, &sum)) {
        return a < 0 ? -INT32_MAX : INT32_MAX;
    }
    return sum;
}

static inline variance add_variance(variance a, variance b)
{
    return add_limited(a, b);
}

/* Sums of products: exact until they are rounded. The limit is half of the range, so that two of them fit. */
static inline wide wide_of(scalar x)
{
    return (wide)x * SCALAR(1);
}

static inline wide add_product(wide sum, scalar a, scalar b)
{
    return sum + (wide)a * b;
}

static inline wide subtract_product(wide sum, scalar a, scalar b)
{
    return sum - (wide)a * b;
}

static inline scalar narrow(wide sum)
{
    return FIXED_ROUNDED(sum, SCALAR_FRACTION, 30);
}

/* Of bits that are not known beforehand. */
scalar fixed_from_raw(int32_t raw, uint8_t fraction_bits);

static inline scalar scalar_from_raw(int32_t raw, uint8_t fraction_bits)
{
    return __builtin_constant_p(fraction_bits) && fraction_bits <= SCALAR_FRACTION
               ? fixed_saturate((int64_t)raw * ((int64_t)1 << (SCALAR_FRACTION - fraction_bits)))
               : fixed_from_raw(raw, fraction_bits);
}

/* The same where |raw| 2^-fraction_bits < 16 is known, and fraction_bits at most SCALAR_FRACTION. */
static inline scalar scalar_from_small(int32_t raw, uint8_t fraction_bits)
{
    return raw * ((int32_t)1 << (SCALAR_FRACTION - fraction_bits));
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
    const int64_t product = (int64_t)v * f;
    return FIXED_ROUNDED(product, SCALAR_FRACTION, 31);
}

/* v + w f */
static inline variance add_scaled_variance(variance v, variance w, scalar f)
{
    return add_variance(v, scale_variance(w, f));
}

/* v > 0. */
inverse invert(variance v);

/* i times f. */
inverse scale_inverse(inverse i, scalar f);

/* v times an inverse: as a gain, because small over smaller can be large, and as a share, for ratios up to 1. */
static inline gain variance_ratio(variance v, inverse i)
{
    return fixed_scaled(v, i.mantissa, 62 - GAIN_FRACTION - i.shift);
}

static inline scalar variance_share(variance v, inverse i)
{
    return fixed_scaled(v, i.mantissa, 62 - SCALAR_FRACTION - i.shift);
}

/* v over w, of which i is the inverse itself, for 0 <= v <= w, with 30 fraction bits: with that known it takes no more
 * than a product. */
static inline uint32_t fixed_part(int32_t v, inverse i)
{
    const uint64_t product = (uint64_t)((uint32_t)v << i.shift) * (uint32_t)i.mantissa; /* 62 fraction bits */
    return (uint32_t)(product >> 32);
}

/* The same as a scalar. */
static inline scalar variance_part(variance v, inverse i)
{
    return (scalar)((fixed_part(v, i) + (1u << (29 - SCALAR_FRACTION))) >> (30 - SCALAR_FRACTION));
}

#endif
