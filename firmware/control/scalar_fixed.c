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
#define ROUNDING_BITS (COEFFICIENT_FRACTION + ARGUMENT_FRACTION - 32 - SCALAR_FRACTION)
#define ROUNDING_HALF (1 << (ROUNDING_BITS - 1))

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
    /* of the product's 59 fraction bits 27 are in its high word; below 2, so there is nothing to limit */
    return ((int32_t)(((int64_t)p * x) >> 32) + ROUNDING_HALF) >> ROUNDING_BITS;
}

/* |x| <= pi/2 */
static inline scalar sine_quarter(scalar x)
{
    return odd_polynomial(SINE, x * (1 << (ARGUMENT_FRACTION - SCALAR_FRACTION)));
}

#include "control/scalar_sine.inc"

/* part / whole as an argument, |part| <= whole. */
static int32_t part_of(scalar part, scalar whole)
{
    const int32_t ratio = (int32_t)(fixed_part(absolute(part), invert(whole)) >> (30 - ARGUMENT_FRACTION));
    return part < 0 ? -ratio : ratio;
}

scalar arctangent(scalar y, scalar x)
{
    const scalar a = absolute(y);
    scalar offset = SCALAR(0);
    int32_t ratio;
    if (mul(a, TAN_PI_8) > x) {
        offset = HALF_PI;
        ratio = -part_of(x, a);
    } else if (a > mul(x, TAN_PI_8)) {
        offset = QUARTER_PI;
        ratio = part_of(a - x, a + x);
    } else {
        ratio = part_of(a, x);
    }
    const scalar angle = offset + odd_polynomial(ARCTANGENT, ratio);
    return y < SCALAR(0) ? -angle : angle;
}

/* Leading zeros, 31 for 1. */
static uint8_t leading_zeros(uint32_t x)
{
    return (uint8_t)__builtin_clz(x);
}

/* floor(n / d) for a quotient below 2^32, n < d 2^32, by two digits of 16 bits: a processor that divides 32 by 32 bits
 * in one instruction needs about forty for this, and some hundred for the compiler's 64-bit division. */
static uint32_t divide(uint64_t n, uint32_t d)
{
    const uint8_t shift = leading_zeros(d);
    const uint32_t divisor = d << shift; /* its first bit is set */
    const uint64_t dividend = n << shift;
    const uint32_t divisor_high = divisor >> 16;
    const uint32_t divisor_low = divisor & 0xFFFFu;
    uint32_t rest = (uint32_t)(dividend >> 32);
    uint32_t quotient = 0;
    for (uint8_t digits = 0; digits < 2u; digits++) {
        const uint32_t next = digits == 0u ? (uint32_t)dividend >> 16 : (uint32_t)dividend & 0xFFFFu;
        uint32_t digit = rest / divisor_high;
        uint32_t digit_rest = rest - digit * divisor_high;
        /* the guess is at most two too large */
        while (digit > 0xFFFFu || digit * divisor_low > (digit_rest << 16 | next)) {
            digit--;
            digit_rest += divisor_high;
            if (digit_rest > 0xFFFFu) {
                break;
            }
        }
        rest = (rest << 16 | next) - digit * divisor;
        quotient = quotient << 16 | digit;
    }
    return quotient;
}

/* Magnitude as unsigned; right for every int32. */
static uint32_t magnitude_of(int32_t x)
{
    return x < 0 ? (uint32_t) - (int64_t)x : (uint32_t)x;
}

int32_t fixed_quotient(int32_t a, int32_t b, uint8_t shift, int32_t most)
{
    const uint64_t numerator = (uint64_t)magnitude_of(a) << shift;
    const uint32_t denominator = magnitude_of(b);
    int32_t quotient = most;
    if (numerator < (uint64_t)denominator * (uint32_t)most) {
        quotient = (int32_t)divide(numerator, denominator);
    }
    return (a < 0) != (b < 0) ? -quotient : quotient;
}

scalar quot(scalar a, scalar b)
{
    if (b == 0) {
        return a < 0 ? -FIXED_LIMIT : FIXED_LIMIT;
    }
    const inverse i = invert(b < 0 ? -b : b);
    const scalar quotient = fixed_scaled(a, i.mantissa, 62 - SCALAR_FRACTION - i.shift);
    return b < 0 ? -quotient : quotient;
}

scalar fraction(uint32_t part, uint32_t whole)
{
    return variance_part((variance)part, invert((variance)whole));
}

/* floor(sqrt(x)), 2^30 <= x. The upper 8 bits by Newton from a line, the lower from the remainder, as in long division:
 * never too small, at most one too large (Zimmermann, Karatsuba Square Root, 1999). */
static uint32_t root_of_word(uint32_t x)
{
    const uint32_t top = x >> 16; /* 2^14..2^16 */
    uint32_t upper = (top >> 9) + 112u;
    upper = (upper + top / upper) >> 1;
    upper = (upper + top / upper) >> 1; /* at most one too large */
    upper -= upper * upper > top ? 1u : 0u;
    const uint32_t rest = (top - upper * upper) << 8 | (x >> 8 & 0xFFu);
    const uint32_t found = (upper << 8) + rest / (2u * upper);
    return found > 0xFFFFu || found * found > x ? found - 1u : found;
}

/* floor(sqrt(x)), 0 < x < 2^62: 16 bits of the root by 16. */
static uint32_t integer_root(uint64_t x)
{
    const uint32_t above = (uint32_t)(x >> 32);
    const uint8_t zeros = above != 0u ? leading_zeros(above) : (uint8_t)(32u + leading_zeros((uint32_t)x));
    const uint8_t shift = zeros & 0xFEu; /* even: half of it is the root's */
    const uint64_t normal = x << shift;
    const uint32_t high = (uint32_t)(normal >> 32);
    const uint32_t upper = root_of_word(high);
    const uint32_t rest = high - upper * upper; /* up to 17 bits: both sides of the quotient are halved */
    const uint64_t found = ((uint64_t)upper << 16) + (rest << 15 | (uint32_t)normal >> 17) / upper;
    const bool too_large = found > UINT32_MAX || found * found > normal;
    return (uint32_t)((too_large ? found - 1u : found) >> (shift / 2u));
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
    const uint8_t shift = leading_zeros((uint32_t)v);
    const uint32_t normal = (uint32_t)v << shift; /* 2^31..2^32 - 1 */
    /* the first 15 bits of 2^62 / normal by division, twice as many by Newton, the last ones by what is left over */
    const uint32_t guess = UINT32_MAX / (normal >> 16) << 14;
    const int64_t missing = ((int64_t)1 << 62) - (int64_t)((uint64_t)normal * guess);
    const uint32_t better = guess + (uint32_t)(((missing >> 32) * (int32_t)guess) >> 30);
    const int64_t left = ((int64_t)1 << 62) - (int64_t)((uint64_t)normal * better);
    const uint32_t mantissa = better + (uint32_t)(left >> 32);
    return (inverse){.mantissa = mantissa > INT32_MAX ? INT32_MAX : (int32_t)mantissa,
                     .shift = (int8_t)shift};
}

inverse scale_inverse(inverse i, scalar f)
{
    if (f == 0) {
        return (inverse){.mantissa = 0, .shift = 0};
    }
    /* f is normalised, so that the high word of the product has its first bits */
    const uint8_t zeros = (uint8_t)(leading_zeros(magnitude_of(f)) - 1u);
    const int32_t normal = f * ((int32_t)1 << zeros);
    const int32_t shift = i.shift + 32 - SCALAR_FRACTION - zeros;
    return (inverse){.mantissa = (int32_t)(((int64_t)i.mantissa * normal) >> 32),
                     .shift = (int8_t)(shift < INVERSE_SHIFT_MOST ? shift : INVERSE_SHIFT_MOST)};
}

scalar fixed_from_raw(int32_t raw, uint8_t fraction_bits)
{
    return fraction_bits <= SCALAR_FRACTION
               ? fixed_saturate((int64_t)raw * ((int64_t)1 << (SCALAR_FRACTION - fraction_bits)))
               : fixed_shifted(raw, (uint8_t)(fraction_bits - SCALAR_FRACTION));
}

int32_t scalar_to_raw(scalar x, uint8_t fraction_bits, int32_t low, int32_t high)
{
    if (fraction_bits >= SCALAR_FRACTION) {
        const int64_t raw = (int64_t)x * ((int64_t)1 << (fraction_bits - SCALAR_FRACTION));
        if (raw < low) {
            return low;
        }
        return raw > high ? high : (int32_t)raw;
    }
    /* half away from zero: the magnitude is rounded half up */
    const uint8_t shift = (uint8_t)(SCALAR_FRACTION - fraction_bits);
    const int32_t magnitude = (int32_t)((magnitude_of(x) + ((uint32_t)1 << (shift - 1))) >> shift);
    return limit(x < 0 ? -magnitude : magnitude, low, high);
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
        const int64_t whole = (int64_t)mantissa * ((int64_t)1 << shift);
        magnitude = whole > INT32_MAX ? INT32_MAX : (int32_t)whole;
    } else if (shift >= -31) {
        magnitude = fixed_shifted(mantissa, (uint8_t)-shift);
    } else {
        magnitude = 0;
    }
    return (bits >> 31) != 0u ? -magnitude : magnitude;
}

/* |number| < 2^(exponent + whole_bits) */
static bool below(uint32_t bits, int8_t exponent, uint8_t whole_bits)
{
    return (int16_t)((bits >> 23) & 0xFFu) - 127 < exponent + whole_bits;
}

bool scalar_holds_real32(uint32_t bits, int8_t exponent)
{
    return below(bits, exponent, 29 - SCALAR_FRACTION);
}

bool gain_holds_real32(uint32_t bits, int8_t exponent)
{
    return below(bits, exponent, 31 - GAIN_FRACTION);
}

scalar scalar_from_real32(uint32_t bits, int8_t exponent)
{
    return from_real32(bits, exponent, SCALAR_FRACTION);
}

gain gain_from_real32(uint32_t bits, int8_t exponent)
{
    return from_real32(bits, exponent, GAIN_FRACTION);
}

uint32_t real32_from_scalar(scalar x, int8_t exponent)
{
    uint32_t magnitude = magnitude_of(x);
    if (magnitude == 0u) {
        return 0;
    }
    const uint32_t sign = x < 0 ? 0x80000000u : 0u;
    const uint8_t zeros = leading_zeros(magnitude);
    /* normalised, 32 bits: 24 of them stay */
    magnitude <<= zeros;
    const uint32_t rest = magnitude & 0xFFu;
    uint32_t mantissa = magnitude >> 8;
    mantissa += rest > 0x80u || (rest == 0x80u && (mantissa & 1u) != 0u) ? 1u : 0u;
    /* value = mantissa * 2^(8 - zeros - fraction + exponent); the mantissa's first bit adds one to the field */
    const int16_t field = (int16_t)(exponent - SCALAR_FRACTION + 8 - zeros + 149);
    return sign | (((uint32_t)field << 23) + mantissa);
}

#endif
