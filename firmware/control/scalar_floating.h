/* The number as `double` or `float`; see control/scalar.h. */
#ifndef CONTROL_SCALAR_FLOATING_H
#define CONTROL_SCALAR_FLOATING_H

#include <stdbool.h>
#include <stdint.h>

#if defined(DIARC_SCALAR_DOUBLE)
typedef double scalar;
#define SCALAR_NAME "double"
#else
typedef float scalar;
#define SCALAR_NAME "float"
#endif

/* Before loops of a few passes: registers for a row of numbers are there, and the passes are short. But code takes
 * flash: not where the compiler is asked for small code. */
#if defined(__OPTIMIZE_SIZE__)
#define UNROLL_SHORT_LOOP
#else
#define UNROLL_SHORT_LOOP _Pragma("GCC unroll 9")
#endif

typedef scalar gain;
typedef scalar variance;
typedef scalar inverse;
typedef scalar wide;

#define SCALAR(real) ((scalar)(real))
#define GAIN(real) ((gain)(real))
#define VARIANCE(real) ((variance)(real))

static inline scalar absolute(scalar x)
{
#if defined(DIARC_SCALAR_DOUBLE)
    return __builtin_fabs(x);
#else
    return __builtin_fabsf(x);
#endif
}

static inline scalar mul(scalar a, scalar b)
{
    return a * b;
}

static inline scalar amp(gain k, scalar x)
{
    return k * x;
}

static inline scalar quot(scalar a, scalar b)
{
    return a / b;
}

static inline gain gain_quot(scalar a, scalar b)
{
    return a / b;
}

static inline gain gain_part(gain k, uint32_t parts)
{
    return k / (gain)parts;
}

static inline scalar add_limited(scalar a, scalar b)
{
    return a + b;
}

static inline variance add_variance(variance a, variance b)
{
    return a + b;
}

static inline wide wide_of(scalar x)
{
    return x;
}

/* In float one instruction of a microcontroller with FPU, rounded once, and so on a host, by its instruction or by libm.
 * In double, the reference, a host's compiler may have neither at hand. */
static inline wide add_product(wide sum, scalar a, scalar b)
{
#if defined(DIARC_SCALAR_DOUBLE)
    return sum + a * b;
#else
    return __builtin_fmaf(a, b, sum);
#endif
}

static inline wide subtract_product(wide sum, scalar a, scalar b)
{
    return add_product(sum, -a, b);
}

static inline scalar narrow(wide sum)
{
    return sum;
}

static inline scalar scalar_from_raw(int32_t raw, uint8_t fraction_bits)
{
    return (scalar)raw / (scalar)((uint32_t)1 << fraction_bits);
}

static inline scalar scalar_from_small(int32_t raw, uint8_t fraction_bits)
{
    return scalar_from_raw(raw, fraction_bits);
}

static inline scalar fraction(uint32_t part, uint32_t whole)
{
    return (scalar)part / (scalar)whole;
}

static inline scalar root(scalar x)
{
#if defined(DIARC_SCALAR_DOUBLE)
    return x > SCALAR(0) ? __builtin_sqrt(x) : SCALAR(0);
#else
    return x > SCALAR(0) ? __builtin_sqrtf(x) : SCALAR(0);
#endif
}

/* v + w f */
static inline variance add_scaled_variance(variance v, variance w, scalar f)
{
    return add_product(v, w, f);
}

static inline variance variance_of(scalar sd)
{
    return sd * sd;
}

static inline scalar sd_of(variance v)
{
    return root(v);
}

static inline variance scale_variance(variance v, scalar f)
{
    return v * f;
}

static inline inverse invert(variance v)
{
    return SCALAR(1) / v;
}

static inline inverse scale_inverse(inverse i, scalar f)
{
    return i * f;
}

static inline gain variance_ratio(variance v, inverse i)
{
    return v * i;
}

static inline scalar variance_share(variance v, inverse i)
{
    return v * i;
}

static inline scalar variance_part(variance v, inverse i)
{
    return v * i;
}

#endif
