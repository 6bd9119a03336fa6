#include "control/scalar.h"

#if defined(DIARC_SCALAR_FIXED)

#define HALF_PI SCALAR(1.57079632679489661923)
#define QUARTER_PI SCALAR(0.78539816339744830962)
#define TAN_PI_8 SCALAR(0.41421356237309504880)

/* Scaling: coefficients have 30 fraction bits, arguments 29; |y| < 2.5 for sine, so partial sums stay below 1.2. */
#define COEFFICIENT(real) FIXED_CONSTANT(real, 1073741824.0)
#define ARGUMENT_FRACTION 29
#define COEFFICIENT_FRACTION 30
#define TERMS 5

static const int32_t SINE[TERMS] = {
    COEFFICIENT(0.999999995698809019),   COEFFICIENT(-0.166666579478460114),
    COEFFICIENT(0.00833305017067177325), COEFFICIENT(-0.000198090174086780038),
    COEFFICIENT(2.60510763533478813e-6),
};
static const int32_t ARCTANGENT[TERMS] = {
    COEFFICIENT(0.999999981264611121),  COEFFICIENT(-0.333327857719248436), COEFFICIENT(0.199740824155076671),
    COEFFICIENT(-0.138484902122692077), COEFFICIENT(0.0797629180679455791),
};

/* x P(x^2), x with 29 fraction bits, |x| < 1.6. */
static scalar odd_polynomial(const int32_t *coefficient, int32_t x)
{
    const int32_t y = (int32_t)(((int64_t)x * x) >> ARGUMENT_FRACTION);
    int32_t p = coefficient[TERMS - 1];
    for (uint8_t k = TERMS - 1; k > 0; k--) {
        p = (int32_t)(((int64_t)p * y) >> ARGUMENT_FRACTION) + coefficient[k - 1];
    }
    return fixed_product(p, x, COEFFICIENT_FRACTION + ARGUMENT_FRACTION - SCALAR_FRACTION);
}

scalar sine_quarter(scalar x)
{
    return odd_polynomial(SINE, x * (1 << (ARGUMENT_FRACTION - SCALAR_FRACTION)));
}

scalar arctangent(scalar y, scalar x)
{
    const scalar a = absolute(y);
    scalar offset = SCALAR(0);
    int32_t ratio;
    if (mul(a, TAN_PI_8) > x) {
        offset = HALF_PI;
        ratio = -fixed_quotient(x, a, ARGUMENT_FRACTION);
    } else if (a > mul(x, TAN_PI_8)) {
        offset = QUARTER_PI;
        ratio = fixed_quotient(a - x, a + x, ARGUMENT_FRACTION);
    } else {
        ratio = fixed_quotient(a, x, ARGUMENT_FRACTION);
    }
    const scalar angle = offset + odd_polynomial(ARCTANGENT, ratio);
    return y < SCALAR(0) ? -angle : angle;
}

int32_t fixed_quotient(int32_t a, int32_t b, uint8_t shift)
{
    if (b == 0) { /* a quotient of anything and nothing is at its limit */
        return a < 0 ? -FIXED_LIMIT : FIXED_LIMIT;
    }
    const int64_t numerator = (int64_t)a * ((int64_t)1 << shift);
    return fixed_saturate(numerator / b);
}

scalar fraction(uint32_t part, uint32_t whole)
{
    return (scalar)(((uint64_t)part << SCALAR_FRACTION) / whole);
}

/* Integer square root, digit by digit: floor(sqrt(x)). */
static uint32_t integer_root(uint64_t x)
{
    uint64_t remainder = x;
    uint64_t result = 0;
    uint64_t bit = (uint64_t)1 << 54; /* x < 2^56 */
    while (bit > remainder) {
        bit >>= 2;
    }
    while (bit != 0u) {
        if (remainder >= result + bit) {
            remainder -= result + bit;
            result = (result >> 1) + bit;
        } else {
            result >>= 1;
        }
        bit >>= 2;
    }
    return (uint32_t)result;
}

scalar root(scalar x)
{
    return x > 0 ? (scalar)integer_root((uint64_t)x << SCALAR_FRACTION) : 0;
}

scalar sd_of(variance v)
{
    /* sqrt(v 2^-30) 2^24 = sqrt(v 2^18) */
    return v > 0 ? (scalar)integer_root((uint64_t)v << (2 * SCALAR_FRACTION - VARIANCE_FRACTION)) : 0;
}

inverse invert(variance v)
{
    const uint8_t shift = (uint8_t)__builtin_clz((uint32_t)v);
    const uint32_t normal = (uint32_t)v << shift; /* 2^31..2^32 - 1 */
    const uint64_t mantissa = ((uint64_t)1 << 62) / normal;
    return (inverse){.mantissa = mantissa > INT32_MAX ? INT32_MAX : (int32_t)mantissa, .shift = shift};
}

scalar scalar_from_raw(int32_t raw, uint8_t fraction_bits)
{
    return fraction_bits <= SCALAR_FRACTION
               ? fixed_saturate((int64_t)raw * ((int64_t)1 << (SCALAR_FRACTION - fraction_bits)))
               : fixed_product(raw, 1, (uint8_t)(fraction_bits - SCALAR_FRACTION));
}

int32_t scalar_to_raw(scalar x, uint8_t fraction_bits, int32_t low, int32_t high)
{
    /* half away from zero: the magnitude is rounded half up */
    const int64_t magnitude =
        ((int64_t)absolute(x) * ((int64_t)1 << fraction_bits) + ((int64_t)1 << (SCALAR_FRACTION - 1))) >>
        SCALAR_FRACTION;
    const int64_t raw = x < 0 ? -magnitude : magnitude;
    if (raw < low) {
        return low;
    }
    return raw > high ? high : (int32_t)raw;
}

/* binary32 times 2^(fraction - exponent), rounded; parameters may use the whole word. */
static int32_t from_real32(uint32_t bits, int16_t exponent, uint8_t fraction_bits)
{
    const int16_t stored_exponent = (int16_t)((bits >> 23) & 0xFFu);
    const int32_t mantissa = (int32_t)(bits & 0x7FFFFFu) | (stored_exponent == 0 ? 0 : 0x800000);
    const int16_t shift =
        (int16_t)((stored_exponent == 0 ? 1 : stored_exponent) - 127 - 23 - exponent + fraction_bits);
    int32_t magnitude;
    if (shift > 30) {
        magnitude = mantissa == 0 ? 0 : INT32_MAX;
    } else if (shift >= 0) {
        const int64_t wide = (int64_t)mantissa * ((int64_t)1 << shift);
        magnitude = wide > INT32_MAX ? INT32_MAX : (int32_t)wide;
    } else if (shift >= -31) {
        magnitude = fixed_product(mantissa, 1, (uint8_t)-shift);
    } else {
        magnitude = 0;
    }
    return (bits >> 31) != 0u ? -magnitude : magnitude;
}

scalar scalar_from_real32(uint32_t bits, int8_t exponent)
{
    return from_real32(bits, exponent, SCALAR_FRACTION);
}

gain gain_from_real32(uint32_t bits, int8_t exponent)
{
    return from_real32(bits, exponent, GAIN_FRACTION);
}

#endif
