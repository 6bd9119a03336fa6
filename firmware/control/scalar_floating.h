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

typedef scalar gain;
typedef scalar variance;
typedef scalar inverse;

#define SCALAR(real) ((scalar)(real))
#define GAIN(real) ((gain)(real))
#define VARIANCE(real) ((variance)(real))

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

static inline gain variance_ratio(variance v, inverse i)
{
    return v * i;
}

static inline scalar variance_share(variance v, inverse i)
{
    return v * i;
}

#endif
