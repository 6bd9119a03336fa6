#include "control/scalar.h"

#if !defined(DIARC_SCALAR_FIXED)

#define HALF_PI SCALAR(1.57079632679489661923)
#define QUARTER_PI SCALAR(0.78539816339744830962)
#define TAN_PI_8 SCALAR(0.41421356237309504880)

/* Odd polynomials x * P(x^2) through the Chebyshev nodes of [0, (pi/2)^2] and [0, tan(pi/8)^2]; truncation
 * error 1.8e-16 and 3.5e-16 (double), 6.7e-9 and 6.8e-9 (float). */
#if defined(DIARC_SCALAR_DOUBLE)
static const scalar SINE[] = {
    SCALAR(0.999999999999999885),     SCALAR(-0.166666666666660726),    SCALAR(0.00833333333328275549),
    SCALAR(-0.000198412698248618956), SCALAR(2.75573166090736739e-6),   SCALAR(-2.50518819467125883e-8),
    SCALAR(1.60481683181656424e-10),  SCALAR(-7.37438750386275741e-13),
};
static const scalar ARCTANGENT[] = {
    SCALAR(0.999999999999999041),   SCALAR(-0.33333333333221434),   SCALAR(0.199999999783926621),
    SCALAR(-0.142857126616847938),  SCALAR(0.111110488537512957),   SCALAR(-0.0908952995656230736),
    SCALAR(0.0767353542818328602),  SCALAR(-0.0650598296717083992), SCALAR(0.0502476211894012803),
    SCALAR(-0.0253164795737764757),
};
#else
static const scalar SINE[] = {
    SCALAR(0.999999995698809019),     SCALAR(-0.166666579478460114),  SCALAR(0.00833305017067177325),
    SCALAR(-0.000198090174086780038), SCALAR(2.60510763533478813e-6),
};
static const scalar ARCTANGENT[] = {
    SCALAR(0.999999981264611121),  SCALAR(-0.333327857719248436), SCALAR(0.199740824155076671),
    SCALAR(-0.138484902122692077), SCALAR(0.0797629180679455791),
};
#endif

static inline scalar odd_polynomial(const scalar *coefficient, uint8_t terms, scalar x)
{
    const scalar y = mul(x, x);
    scalar p = coefficient[terms - 1];
    UNROLL_SHORT_LOOP
    for (uint8_t k = (uint8_t)(terms - 1); k > 0; k--) {
        p = narrow(add_product(wide_of(coefficient[k - 1]), p, y));
    }
    return mul(p, x);
}

/* |x| <= pi/2 */
static inline scalar sine_quarter(scalar x)
{
    return odd_polynomial(SINE, (uint8_t)(sizeof SINE / sizeof SINE[0]), x);
}

#include "control/scalar_sine.inc"

scalar arctangent(scalar y, scalar x)
{
    const scalar a = absolute(y);
    scalar offset = SCALAR(0);
    scalar ratio;
    if (mul(a, TAN_PI_8) > x) {
        offset = HALF_PI;
        ratio = -quot(x, a);
    } else if (a > mul(x, TAN_PI_8)) {
        offset = QUARTER_PI;
        ratio = quot(a - x, a + x);
    } else {
        ratio = quot(a, x);
    }
    const scalar angle =
        offset + odd_polynomial(ARCTANGENT, (uint8_t)(sizeof ARCTANGENT / sizeof ARCTANGENT[0]), ratio);
    return y < SCALAR(0) ? -angle : angle;
}

/* 2^exponent, by repeated exact doubling or halving. */
static scalar power_of_two(int16_t exponent)
{
    scalar value = SCALAR(1);
    for (; exponent > 0; exponent--) {
        value = value * SCALAR(2);
    }
    for (; exponent < 0; exponent++) {
        value = value * SCALAR(0.5);
    }
    return value;
}

int32_t scalar_to_raw(scalar x, uint8_t fraction_bits, int32_t low, int32_t high)
{
    const scalar scaled = x * (scalar)((uint32_t)1 << fraction_bits);
    if (!(scaled > (scalar)low)) {
        return low; /* a NaN comes here too */
    }
    if (scaled >= (scalar)high) {
        return high;
    }
    return (int32_t)(scaled < SCALAR(0) ? scaled - SCALAR(0.5) : scaled + SCALAR(0.5));
}

scalar scalar_from_real32(uint32_t bits, int8_t exponent)
{
    const int16_t stored_exponent = (int16_t)((bits >> 23) & 0xFFu);
    const int32_t fraction_field = (int32_t)(bits & 0x7FFFFFu);
    /* subnormals have no hidden bit and the exponent of the smallest normal number */
    const int32_t mantissa = stored_exponent == 0 ? fraction_field : fraction_field | 0x800000;
    const int16_t binary_exponent = (int16_t)((stored_exponent == 0 ? 1 : stored_exponent) - 127 - 23);
    const scalar magnitude = (scalar)mantissa * power_of_two((int16_t)(binary_exponent - exponent));
    return (bits >> 31) != 0u ? -magnitude : magnitude;
}

bool scalar_holds_real32(uint32_t bits, int8_t exponent)
{
    (void)bits;
    (void)exponent;
    return true;
}

bool gain_holds_real32(uint32_t bits, int8_t exponent)
{
    return scalar_holds_real32(bits, exponent);
}

gain gain_from_real32(uint32_t bits, int8_t exponent)
{
    return scalar_from_real32(bits, exponent);
}

/* binary32: 24 bits of mantissa; the smallest step is 2^-149, the largest number below 2^24 * 2^104. */
#define REAL32_MANTISSA_END SCALAR(16777216)
#define REAL32_EXPONENT_LOW (-149)
#define REAL32_EXPONENT_HIGH 104
#define REAL32_STRIDE SCALAR(256)
#define REAL32_STRIDE_BITS 8
#define REAL32_INFINITY 0x7F800000u
#define REAL32_NAN 0x7FC00000u

uint32_t real32_from_scalar(scalar x, int8_t exponent)
{
    const uint32_t sign = x < SCALAR(0) ? 0x80000000u : 0u;
    scalar magnitude = absolute(x);
    int16_t step = exponent; /* the number is magnitude * 2^step */
    if (!(magnitude >= SCALAR(0))) {
        return REAL32_NAN;
    }
    /* by strides while it is far away */
    while (magnitude >= REAL32_MANTISSA_END * REAL32_STRIDE && step <= REAL32_EXPONENT_HIGH) {
        magnitude = magnitude * (SCALAR(1) / REAL32_STRIDE);
        step += REAL32_STRIDE_BITS;
    }
    while (magnitude < REAL32_MANTISSA_END / REAL32_STRIDE &&
           step > REAL32_EXPONENT_LOW + REAL32_STRIDE_BITS) {
        magnitude = magnitude * REAL32_STRIDE;
        step -= REAL32_STRIDE_BITS;
    }
    while (magnitude >= REAL32_MANTISSA_END && step <= REAL32_EXPONENT_HIGH) {
        magnitude = magnitude * SCALAR(0.5);
        step++;
    }
    while (magnitude < REAL32_MANTISSA_END * SCALAR(0.5) && step > REAL32_EXPONENT_LOW) {
        magnitude = magnitude * SCALAR(2);
        step--;
    }
    if (step > REAL32_EXPONENT_HIGH) {
        return sign | REAL32_INFINITY;
    }
    uint32_t mantissa = (uint32_t)magnitude;
    const scalar rest = magnitude - (scalar)mantissa;
    const bool odd = (mantissa & 1u) != 0u;
    mantissa += rest > SCALAR(0.5) || (rest >= SCALAR(0.5) && odd) ? 1u : 0u;
    /* The first bit of a normal number adds one to the exponent's field, a carry out of the mantissa another one; so
     * subnormals, and a sum that becomes infinite, come out right by themselves. */
    return sign | (((uint32_t)(step - REAL32_EXPONENT_LOW) << 23) + mantissa);
}

#endif
