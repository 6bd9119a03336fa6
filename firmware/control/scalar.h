/* The number of the control law: one type, chosen at build time, and its few operations. `double` is the
 * reference, `float` is for a microcontroller with a floating-point unit, `fixed` for one without.
 *
 * Everything in control/ is per unit (see quantities in ecu/parameters.h): each quantity is divided by a
 * base so that it is of order one. Sums are plain `+` for every type; only products, quotients and functions
 * go through the operations below. Sine, arctangent and root are our own polynomials and the one instruction
 * that is correctly rounded everywhere, so that a host and a microcontroller give the same bits. */
#ifndef CONTROL_SCALAR_H
#define CONTROL_SCALAR_H

#include <stdbool.h>
#include <stdint.h>

/* scalar    a per-unit quantity
 * gain      in 1/s or 1/s^2: hundreds where a scalar is of order one; amp() is its product with a scalar
 * variance  of an estimate, between 0 and 1 of a range squared: small where a scalar is of order one
 * inverse   of a variance, ready to multiply by
 * wide      a sum of products before it is rounded: narrow(add_product(wide_of(c), a, b)) is c + a b
 *
 * SCALAR(real), GAIN(real), VARIANCE(real): constants written as real numbers. */
#if defined(DIARC_SCALAR_DOUBLE) || defined(DIARC_SCALAR_FLOAT)
#include "control/scalar_floating.h"
#elif defined(DIARC_SCALAR_FIXED)
#include "control/scalar_fixed.h"
#else
#error "choose the number type: DIARC_SCALAR_DOUBLE, DIARC_SCALAR_FLOAT or DIARC_SCALAR_FIXED"
#endif

static inline scalar smaller(scalar a, scalar b)
{
    return a < b ? a : b;
}

static inline scalar larger(scalar a, scalar b)
{
    return a > b ? a : b;
}

/* sat: x limited to low..high; low <= high. A NaN becomes low. */
static inline scalar limit(scalar x, scalar low, scalar high)
{
    if (!(x >= low)) {
        return low;
    }
    return x > high ? high : x;
}

/* A function whose variables must not lie on the stack below what its caller calls besides it. */
#define OWN_FRAME __attribute__((noinline))

/* A function that runs once, or when a mode begins: made small instead of fast. */
#define SELDOM __attribute__((cold))

/* Sine and cosine of an angle in rad, |x| <= 2 pi. Error at most 5e-16 (double), 2.8e-7 (float, 1.6e-7 within
 * pi and fixed). */
scalar sine(scalar x);
scalar cosine(scalar x);

/* Both at once. */
struct sine_cosine {
    scalar s, c;
};
struct sine_cosine sine_cosine(scalar x);

/* Arctangent of y / x in rad, x > 0, -pi/2..pi/2. Error at most 7e-16 (double), 1.5e-7 (float and fixed);
 * as a ratio it needs no quotient beyond 1. */
scalar arctangent(scalar y, scalar x);

/* scalar_from_raw(raw, fraction_bits) is raw * 2^-fraction_bits, for |raw| < 2^31 and 0 <= fraction_bits <= 31;
 * scalar_from_small the same for |raw| * 2^-fraction_bits < 16 and fraction_bits <= 24, without a limit. */

/* x * 2^fraction_bits to the nearest integer, halves away from zero, limited to low..high. */
int32_t scalar_to_raw(scalar x, uint8_t fraction_bits, int32_t low, int32_t high);

/* The number whose IEEE 754 binary32 bits are given, times 2^-exponent; |exponent| <= 96, exact where the
 * type has the bits. Not for infinities and NaN. */
scalar scalar_from_real32(uint32_t bits, int8_t exponent);
gain gain_from_real32(uint32_t bits, int8_t exponent);

/* Whether the type holds such a number with the room that sums and products need. */
bool scalar_holds_real32(uint32_t bits, int8_t exponent);
bool gain_holds_real32(uint32_t bits, int8_t exponent);

/* The binary32 bits of x * 2^exponent, to the nearest, halves to even; |exponent| <= 96. */
uint32_t real32_from_scalar(scalar x, int8_t exponent);

#endif
