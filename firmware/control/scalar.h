/* The number of the control law: one type, chosen at build time, and its few operations.
 *
 * Everything in control/ is per unit (see quantities in ecu/parameters.h): each quantity is divided by a
 * base so that it is of order one. Sums are plain `+` for every type; only products, quotients and functions
 * go through the operations below. Sine, arctangent and root are our own polynomials and the one instruction
 * that is correctly rounded everywhere, so that a host and a microcontroller give the same bits. */
#ifndef CONTROL_SCALAR_H
#define CONTROL_SCALAR_H

#include <stdbool.h>
#include <stdint.h>

#if defined(DIARC_SCALAR_DOUBLE)
typedef double scalar;
#define SCALAR_NAME "double"
#elif defined(DIARC_SCALAR_FLOAT)
typedef float scalar;
#define SCALAR_NAME "float"
#else
#error "choose the number type: DIARC_SCALAR_DOUBLE or DIARC_SCALAR_FLOAT"
#endif

/* A gain in 1/s or 1/s^2: hundreds where a scalar is of order one. A type of its own so that fixed point can
 * give it more room; amp() is its product with a scalar. */
typedef scalar gain;

/* A constant written as a real number. */
#define SCALAR(real) ((scalar)(real))
#define GAIN(real) ((gain)(real))

/* Product of two scalars. */
static inline scalar mul(scalar a, scalar b)
{
    return a * b;
}

/* Gain times scalar. */
static inline scalar amp(gain k, scalar x)
{
    return k * x;
}

/* Gain times gain, in gain's range. */
static inline gain gain_product(gain a, gain b)
{
    return a * b;
}

/* Gain as a scalar fraction of another, a / b; b > 0. */
static inline scalar gain_ratio(gain a, gain b)
{
    return a / b;
}

/* Quotient a / b; b != 0, the caller guards it. */
static inline scalar quot(scalar a, scalar b)
{
    return a / b;
}

/* Square root of x, 0 for x < 0. */
static inline scalar root(scalar x)
{
#if defined(DIARC_SCALAR_DOUBLE)
    return x > SCALAR(0) ? __builtin_sqrt(x) : SCALAR(0);
#else
    return x > SCALAR(0) ? __builtin_sqrtf(x) : SCALAR(0);
#endif
}

static inline scalar absolute(scalar x)
{
    return x < SCALAR(0) ? -x : x;
}

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

/* Sine and cosine of an angle in rad, |x| <= 2 pi. Error at most 4e-16 (double), 1.2e-7 (float). */
scalar sine(scalar x);
scalar cosine(scalar x);

/* Arctangent in rad, any x. Error at most 7e-16 (double), 1.2e-7 (float). */
scalar arctangent(scalar x);

/* raw * 2^-fraction_bits, for |raw| < 2^31 and 0 <= fraction_bits <= 31. */
scalar scalar_from_raw(int32_t raw, uint8_t fraction_bits);

/* x * 2^fraction_bits to the nearest integer, halves away from zero, limited to low..high. */
int32_t scalar_to_raw(scalar x, uint8_t fraction_bits, int32_t low, int32_t high);

/* The number whose IEEE 754 binary32 bits are given, times 2^-exponent; |exponent| <= 96, exact where the
 * type has the bits. Not for infinities and NaN. */
scalar scalar_from_real32(uint32_t bits, int8_t exponent);
gain gain_from_real32(uint32_t bits, int8_t exponent);

#endif
