/* What several unit tests need: numbers of every type, units, seeded noise, the reference machine. */
#ifndef TESTING_H
#define TESTING_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "ecu/parameters.h"
#include "tests/unit/frames.h"
#include "tests/unit/parameter_images.h"
#include "unity.h"

#define COUNT_OF(array) (sizeof(array) / sizeof((array)[0]))
#define PI_REAL 3.14159265358979323846

/* One of three by the number type: how a test file states its tolerances. */
#if defined(DIARC_SCALAR_DOUBLE)
#define BY_TYPE(of_double, of_float, of_fixed) (of_double)
#elif defined(DIARC_SCALAR_FLOAT)
#define BY_TYPE(of_double, of_float, of_fixed) (of_float)
#else
#define BY_TYPE(of_double, of_float, of_fixed) (of_fixed)
#endif

/* The step of a number of order one: what a constant may be off by, and twice a product. */
#define STEP BY_TYPE(0x1p-52, 0x1p-23, 0x1p-24)

/* Numbers to reals, and reals known only at run time to numbers: SCALAR(real) is for constants. What does not fit
 * into fixed point is the test's own error. */
#if defined(DIARC_SCALAR_FIXED)
static inline double real(scalar x)
{
    return x * 0x1p-24;
}

static inline double real_gain(gain k)
{
    return k * 0x1p-18;
}

static inline double real_variance(variance v)
{
    return v * 0x1p-30;
}

static inline int32_t fixed_from_real(double x, double one)
{
    TEST_ASSERT_TRUE_MESSAGE(fabs(x * one) <= 2147483647.0, "the test leaves fixed point's range");
    return FIXED_CONSTANT(x, one);
}

static inline scalar from_real(double x)
{
    return fixed_from_real(x, 0x1p24);
}

static inline gain gain_from_real(double x)
{
    return fixed_from_real(x, 0x1p18);
}

static inline variance variance_from_real(double x)
{
    return fixed_from_real(x, 0x1p30);
}
#else
static inline double real(scalar x)
{
    return (double)x;
}

static inline double real_gain(gain k)
{
    return (double)k;
}

static inline double real_variance(variance v)
{
    return (double)v;
}

static inline scalar from_real(double x)
{
    return (scalar)x;
}

static inline gain gain_from_real(double x)
{
    return (gain)x;
}

static inline variance variance_from_real(double x)
{
    return (variance)x;
}
#endif

/* SI to per unit and back; base_log2 is the binary logarithm of the quantity's base. */
static inline scalar per_unit(double si, int base_log2)
{
    return from_real(ldexp(si, -base_log2));
}

static inline double si_of(scalar x, int base_log2)
{
    return ldexp(real(x), base_log2);
}

/* Knuth's 64-bit linear congruential generator: the same numbers on every machine. */
struct lcg {
    uint64_t state;
};

/* Uniform in low..high. */
static inline double lcg_uniform(struct lcg *lcg, double low, double high)
{
    lcg->state = lcg->state * 6364136223846793005u + 1442695040888963407u;
    return low + (high - low) * (double)(lcg->state >> 11) * 0x1p-53;
}

/* The built-in machine. */
static inline void load_reference_arm(struct machine *machine, struct bases *bases)
{
    uint16_t entry = 0;
    memset(machine, 0, sizeof *machine);
    TEST_ASSERT_EQUAL_INT(ECU_OK, parameters_load(machine, bases, &default_parameter_image, &entry));
}

static inline uint16_t entry_named(const char *name)
{
    uint16_t k = 0;
    while (k < PARAMETER_COUNT && strcmp(parameter_name(k), name) != 0) {
        k++;
    }
    TEST_ASSERT_LESS_THAN_UINT16_MESSAGE(PARAMETER_COUNT, k, name);
    return k;
}

/* SI value of a parameter of the built-in image. */
static inline double default_value(const char *name)
{
    const uint32_t bits = image_u32(&default_parameter_image, IMAGE_HEADER_BYTES + 4u * entry_named(name));
    float value;
    memcpy(&value, &bits, sizeof value);
    return (double)value;
}

#endif
