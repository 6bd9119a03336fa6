/* The number of the law (control/scalar) against libm and against exact arithmetic. What only fixed point has to
 * answer for is in test_fixed_point.c. */
#include <float.h>

#include "testing.h"

/* The bounds of scalar.h or better; fixed point's arctangent is that good when one of its arguments is at least
 * ARCTANGENT_LEAST, for less see test_fixed_point.c. */
#define SINE_BOUND BY_TYPE(5e-16, 2.8e-7, 8.3e-8)
#define SINE_BOUND_WITHIN_PI BY_TYPE(5e-16, 1.6e-7, 8.3e-8)
#define ARCTANGENT_BOUND BY_TYPE(7e-16, 1.5e-7, 6.1e-8)
#define ARCTANGENT_LEAST BY_TYPE(1e-12, 1e-12, 0x1p-16)

/* Numbers this long have exact squares. */
#define HALF_DIGITS BY_TYPE(26, 12, 12)

#define ONE_TURN 6.2831853

#if defined(DIARC_SCALAR_DOUBLE)
#define MOST DBL_MAX
#define LEAST 4.9406564584124654e-324
#define INFINITE ((double)INFINITY)
#elif defined(DIARC_SCALAR_FLOAT)
#define MOST FLT_MAX
#define LEAST 1.40129846e-45f
#define INFINITE INFINITY
#else
#define MOST INT32_MAX
#define LEAST 1
#endif

void setUp(void)
{
}

void tearDown(void)
{
}

static scalar next_up(scalar x)
{
#if defined(DIARC_SCALAR_DOUBLE)
    return nextafter(x, INFINITE);
#elif defined(DIARC_SCALAR_FLOAT)
    return nextafterf(x, INFINITE);
#else
    return x + 1;
#endif
}

static scalar next_down(scalar x)
{
    return -next_up(-x);
}

/* The number itself, exactly. */
static long double exactly(scalar x)
{
    return BY_TYPE((long double)x, (long double)x, (long double)x * 0x1p-24L);
}

/* Libm in long double is the truth: its own error is far below the bounds. */
static void expect_sine_and_cosine(scalar x)
{
    const double bound = fabsl(exactly(x)) <= 3.14159265L ? SINE_BOUND_WITHIN_PI : SINE_BOUND;
    TEST_ASSERT_DOUBLE_WITHIN(bound, 0, (double)(exactly(sine(x)) - sinl(exactly(x))));
    TEST_ASSERT_DOUBLE_WITHIN(SINE_BOUND, 0, (double)(exactly(cosine(x)) - cosl(exactly(x))));
}

static void expect_arctangent(scalar y, scalar x)
{
    const long double truth = atan2l(exactly(y), exactly(x));
    TEST_ASSERT_DOUBLE_WITHIN(ARCTANGENT_BOUND, 0, (double)(exactly(arctangent(y, x)) - truth));
}

static void test_sine_or_cosine_beyond_its_bound(void)
{
    /* GIVEN angles over both turns WHEN compared with libm THEN the error is what scalar.h says */
    const int steps = 100000;
    for (int k = -steps; k <= steps; k++) {
        expect_sine_and_cosine(from_real(ONE_TURN * k / steps));
    }
}

static void test_sine_or_cosine_wrong_where_its_branches_meet(void)
{
    /* GIVEN the multiples of a quarter turn and their neighbours WHEN compared THEN no branch is worse */
    for (int k = -4; k <= 4; k++) {
        scalar x = from_real(k * PI_REAL / 2);
        x = k == 4 ? next_down(x) : k == -4 ? next_up(x) : x; /* the range ends at 2 pi */
        expect_sine_and_cosine(x);
        expect_sine_and_cosine(k < 4 ? next_up(x) : x);
        expect_sine_and_cosine(k > -4 ? next_down(x) : x);
    }
    expect_sine_and_cosine(LEAST);
    TEST_ASSERT_TRUE(sine(SCALAR(0)) == SCALAR(0));
}

static void test_left_and_right_turns_differ(void)
{
    /* GIVEN an angle and its mirror image WHEN computed THEN the bits mirror too */
    for (int k = 0; k <= 1000; k++) {
        const scalar x = from_real(ONE_TURN * k / 1000);
        TEST_ASSERT_TRUE(sine(-x) == -sine(x));
        TEST_ASSERT_TRUE(cosine(-x) == cosine(x));
        TEST_ASSERT_TRUE(arctangent(-x, SCALAR(0.7)) == -arctangent(x, SCALAR(0.7)));
    }
}

static void test_arctangent_beyond_its_bound(void)
{
    /* GIVEN ratios and numbers of every size WHEN compared with libm THEN the error is what scalar.h says */
    const double most = BY_TYPE(1e12, 1e12, 31);
    for (double size = ARCTANGENT_LEAST; size < most; size *= 7) {
        const scalar x = from_real(size);
        for (double ratio = 1e-9; ratio < 1e12 && size * ratio < most; ratio *= 1.0015) {
            expect_arctangent(from_real(size * ratio), x);
            expect_arctangent(from_real(-size * ratio), x);
        }
    }
    for (int k = 0; k <= 30000; k++) {
        expect_arctangent(from_real(k * 1e-4), SCALAR(1));
        expect_arctangent(from_real(k * 1e-4), SCALAR(1.0 / 900)); /* friction's */
    }
}

static void test_arctangent_wrong_where_its_branches_meet(void)
{
    /* GIVEN tan(pi/8), 1, tan(3 pi/8), zero and the largest WHEN compared THEN no branch is worse */
    static const double corners[] = {0.41421356237309504880, 1.0, 2.41421356237309504880};
    for (unsigned k = 0; k < COUNT_OF(corners); k++) {
        for (double x = 1; x > 1e-3; x /= 3) {
            const scalar y = from_real(corners[k] * x);
            expect_arctangent(y, from_real(x));
            expect_arctangent(next_up(y), from_real(x));
            expect_arctangent(next_down(y), from_real(x));
        }
    }
    expect_arctangent(LEAST, SCALAR(1));
    expect_arctangent(SCALAR(1), LEAST);
    expect_arctangent(LEAST, LEAST);
    TEST_ASSERT_TRUE(arctangent(SCALAR(0), SCALAR(1)) == SCALAR(0));
    TEST_ASSERT_TRUE(arctangent(SCALAR(0), LEAST) == SCALAR(0));
#if !defined(DIARC_SCALAR_FIXED)
    expect_arctangent(MOST, SCALAR(1));
    expect_arctangent(INFINITE, SCALAR(1));
    expect_arctangent(-INFINITE, SCALAR(1));
#endif
}

static void test_root_of_a_negative_is_no_number(void)
{
    /* GIVEN a pressure drop that noise made negative WHEN rooted THEN 0 */
    TEST_ASSERT_TRUE(root(SCALAR(-1e-6)) == SCALAR(0));
    TEST_ASSERT_TRUE(root(-LEAST) == SCALAR(0));
    TEST_ASSERT_TRUE(root(-MOST) == SCALAR(0));
    TEST_ASSERT_TRUE(root(SCALAR(0)) == SCALAR(0));
#if !defined(DIARC_SCALAR_FIXED)
    TEST_ASSERT_TRUE(root(-INFINITE) == SCALAR(0));
    TEST_ASSERT_TRUE(root((scalar)NAN) == SCALAR(0));
#endif
}

static void test_root_not_correctly_rounded(void)
{
    /* GIVEN squares of short numbers WHEN rooted THEN the number itself, bit for bit */
    for (int n = 1; n < 2048; n++) {
        const double x = ldexp((1 << HALF_DIGITS) - n, -HALF_DIGITS);
        TEST_ASSERT_TRUE(root(from_real(x * x)) == from_real(x));
    }
}

static void test_limit_lets_something_through(void)
{
    /* GIVEN values around the bounds, the largest, infinities and NaN WHEN limited THEN each is within; NaN
     * becomes low */
    const scalar low = SCALAR(-1);
    const scalar high = SCALAR(0.5);
    TEST_ASSERT_TRUE(limit(SCALAR(0.25), low, high) == SCALAR(0.25));
    TEST_ASSERT_TRUE(limit(low, low, high) == low);
    TEST_ASSERT_TRUE(limit(high, low, high) == high);
    TEST_ASSERT_TRUE(limit(next_down(low), low, high) == low);
    TEST_ASSERT_TRUE(limit(next_up(high), low, high) == high);
    TEST_ASSERT_TRUE(limit(MOST, low, high) == high);
    TEST_ASSERT_TRUE(limit(-MOST, low, high) == low);
#if !defined(DIARC_SCALAR_FIXED)
    TEST_ASSERT_TRUE(limit(INFINITE, low, high) == high);
    TEST_ASSERT_TRUE(limit(-INFINITE, low, high) == low);
    TEST_ASSERT_TRUE(limit((scalar)NAN, low, high) == low);
#endif
}

static void test_raw_rounded_to_even_or_down(void)
{
    /* GIVEN every half step WHEN encoded THEN it rounds away from zero; a bit less does not */
    for (int k = 0; k < 2000; k++) {
        const scalar half = from_real((k + 0.5) / 16384);
        TEST_ASSERT_EQUAL_INT32(k + 1, scalar_to_raw(half, 14, -16384, 16384));
        TEST_ASSERT_EQUAL_INT32(-k - 1, scalar_to_raw(-half, 14, -16384, 16384));
        TEST_ASSERT_EQUAL_INT32(k, scalar_to_raw(from_real((k + 0.499) / 16384), 14, -16384, 16384));
        TEST_ASSERT_EQUAL_INT32(-k, scalar_to_raw(from_real((k + 0.499) / -16384), 14, -16384, 16384));
    }
    /* the last half step below the end of 24 bits, where a float has no bit to spare */
    TEST_ASSERT_EQUAL_INT32(4194304, scalar_to_raw(SCALAR(4194303.5 * 0x1p-22), 22, -8388607, 8388607));
    TEST_ASSERT_EQUAL_INT32(-4194304, scalar_to_raw(SCALAR(-4194303.5 * 0x1p-22), 22, -8388607, 8388607));
}

static void test_raw_wraps_instead_of_saturating(void)
{
    /* GIVEN values at and beyond the ends WHEN encoded THEN the ends */
    TEST_ASSERT_EQUAL_INT32(16384, scalar_to_raw(SCALAR(1), 14, -16384, 16384));
    TEST_ASSERT_EQUAL_INT32(-16384, scalar_to_raw(SCALAR(-1), 14, -16384, 16384));
    TEST_ASSERT_EQUAL_INT32(16384, scalar_to_raw(SCALAR(1.001), 14, -16384, 16384));
    TEST_ASSERT_EQUAL_INT32(-16384, scalar_to_raw(SCALAR(-1.001), 14, -16384, 16384));
    TEST_ASSERT_EQUAL_INT32(8388607, scalar_to_raw(SCALAR(8388606.75 * 0x1p-22), 22, -8388607, 8388607));
    TEST_ASSERT_EQUAL_INT32(-8388607, scalar_to_raw(SCALAR(-8388606.75 * 0x1p-22), 22, -8388607, 8388607));
    TEST_ASSERT_EQUAL_INT32(65535, scalar_to_raw(SCALAR(70000 * 0x1p-16), 16, 0, 65535));
    TEST_ASSERT_EQUAL_INT32(0, scalar_to_raw(SCALAR(-3), 0, 0, 65535));
    TEST_ASSERT_EQUAL_INT32(INT32_MAX, scalar_to_raw(SCALAR(3e9 * 0x1p-26), 26, INT32_MIN, INT32_MAX));
    TEST_ASSERT_EQUAL_INT32(INT32_MIN, scalar_to_raw(SCALAR(-3e9 * 0x1p-26), 26, INT32_MIN, INT32_MAX));
    TEST_ASSERT_EQUAL_INT32(8388607, scalar_to_raw(MOST, 31, -8388607, 8388607));
    TEST_ASSERT_EQUAL_INT32(-8388607, scalar_to_raw(-MOST, 31, -8388607, 8388607));
#if !defined(DIARC_SCALAR_FIXED)
    TEST_ASSERT_EQUAL_INT32(8388607, scalar_to_raw(INFINITE, 0, -8388607, 8388607));
    TEST_ASSERT_EQUAL_INT32(-8388607, scalar_to_raw(-INFINITE, 0, -8388607, 8388607));
#endif
}

#if !defined(DIARC_SCALAR_FIXED)
static void test_raw_of_nan_undefined(void)
{
    /* GIVEN no number WHEN encoded THEN the low end, not whatever the processor makes of it */
    TEST_ASSERT_EQUAL_INT32(-8388607, scalar_to_raw((scalar)NAN, 21, -8388607, 8388607));
    TEST_ASSERT_EQUAL_INT32(0, scalar_to_raw((scalar)NAN, 14, 0, 65535));
}
#endif

static void test_raw_does_not_come_back(void)
{
    /* GIVEN raw values of 24 bits WHEN decoded THEN exact; WHEN encoded again THEN the same raw value */
    TEST_ASSERT_TRUE(scalar_from_raw(1, BY_TYPE(31, 31, 24)) == SCALAR(BY_TYPE(0x1p-31, 0x1p-31, 0x1p-24)));
    TEST_ASSERT_TRUE(scalar_from_raw(-3, 0) == SCALAR(-3));
    TEST_ASSERT_TRUE(scalar_from_raw(-8388607, 21) == SCALAR(-8388607 * 0x1p-21));
    for (int32_t raw = -8388607; raw <= 8388607; raw += 997) {
        const scalar x = scalar_from_raw(raw, 22);
        TEST_ASSERT_TRUE(x == from_real(raw * 0x1p-22));
        TEST_ASSERT_EQUAL_INT32(raw, scalar_to_raw(x, 22, -8388607, 8388607));
    }
}

/* What the type makes of a real: exact, or fixed point's nearest number and the end of its word. */
static double nearest(double x, double step)
{
    const double word = step * fmax(fmin(round(x / step), 2147483647), -2147483647);
    const bool floating = BY_TYPE(true, true, false);
    return floating ? x : word;
}

static void expect_real32(float value, int8_t exponent)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    const double expected = ldexp((double)value, -exponent); /* exact: a power of two */
    TEST_ASSERT_TRUE(real(scalar_from_real32(bits, exponent)) == nearest(expected, 0x1p-24));
    TEST_ASSERT_TRUE(real_gain(gain_from_real32(bits, exponent)) == nearest(expected, 0x1p-18));
}

static void test_parameter_bits_read_inexactly(void)
{
    /* GIVEN binary32 numbers of all kinds and bases as powers of two WHEN read THEN exact where the type has
     * the bits, else the nearest number */
    static const float values[] = {0.0f, 1.0f,    -1.0f,   9.81f,   -0.7f,
                                   1e7f, 3.4e-8f, FLT_MAX, FLT_MIN, 1.9999999f};
    for (unsigned k = 0; k < COUNT_OF(values); k++) {
        expect_real32(values[k], 0);
        expect_real32(-values[k], 0);
    }
    expect_real32(1e7f, 22);    /* supply pressure */
    expect_real32(2e-13f, -37); /* leakage */
    expect_real32(-1e-6f, -15); /* a flow offset */
    expect_real32(8000.0f, 0);  /* the largest gain */
    for (int exponent = -96; exponent <= 96; exponent++) {
        for (unsigned k = 0; k < COUNT_OF(values); k++) {
            const double expected = ldexp((double)values[k], -exponent);
            if (fabs(expected) <= (double)FLT_MAX && (fabs(expected) >= (double)FLT_MIN || expected == 0)) {
                expect_real32(values[k], (int8_t)exponent);
                expect_real32(-values[k], (int8_t)exponent);
            }
        }
    }
}

static void test_subnormal_parameter_gets_a_hidden_bit(void)
{
    /* GIVEN subnormal binary32 numbers WHEN read THEN no hidden bit is added to them */
    expect_real32(1.40129846e-45f, 0);
    expect_real32(1.40129846e-45f, -96);
    expect_real32(-5.87747175e-39f, -20);
    expect_real32(1.17549421e-38f, -96);
}

/* The nearest binary32 number is what the host's own conversion gives. */
static void expect_real32_of(scalar x, int8_t exponent)
{
    const float expected = (float)ldexp(real(x), exponent);
    uint32_t bits;
    memcpy(&bits, &expected, sizeof bits);
    TEST_ASSERT_EQUAL_HEX32(bits, real32_from_scalar(x, exponent));
}

static void test_estimate_told_as_another_number(void)
{
    /* GIVEN numbers of all sizes, ties between two binary32 numbers, the largest, the smallest, zero WHEN turned into
     * binary32 THEN the nearest, halves to even; and a parameter comes back as it was */
    struct lcg lcg = {7};
    static const double values[] = {0,         1,       0.1,       1.0 + 0x1p-24, 1.0 + 0x3p-24,
                                    31.999999, 0x1p-24, 0x1.8p-20, 5.0 - 0x1p-22};
    for (int exponent = -96; exponent <= 96; exponent++) {
        for (unsigned k = 0; k < COUNT_OF(values); k++) {
            expect_real32_of(from_real(values[k]), (int8_t)exponent);
            if (values[k] > 0) {
                expect_real32_of(from_real(-values[k]), (int8_t)exponent);
            }
        }
        const scalar x = from_real(lcg_uniform(&lcg, -32, 32));
        expect_real32_of(x, (int8_t)exponent);
    }
    expect_real32_of(MOST, 0);
    expect_real32_of(LEAST, 0);
#if defined(DIARC_SCALAR_FIXED)
    expect_real32_of(INT32_MIN, 0);
    expect_real32_of(0x01FFFFFF, 0); /* rounds up to the next power of two */
#else
    expect_real32_of(SCALAR(FLT_MAX), 1); /* infinite */
    expect_real32_of(SCALAR(FLT_MAX), 96);
    expect_real32_of(SCALAR(FLT_MIN), -3);
    expect_real32_of(SCALAR(FLT_MIN) * SCALAR(1.7), -20);
    TEST_ASSERT_EQUAL_HEX32(0x7FC00000u, real32_from_scalar((scalar)NAN, 0));
#endif
    for (int k = 0; k < 1000; k++) {
        const float value = (float)lcg_uniform(&lcg, -30, 30);
        const int8_t exponent = (int8_t)(k % 20);
        uint32_t bits;
        memcpy(&bits, &value, sizeof bits);
        const scalar x = scalar_from_real32(bits, 0);
        TEST_ASSERT_TRUE(scalar_from_real32(real32_from_scalar(x, 0), 0) == x); /* no more than 24 bits */
        expect_real32_of(x, exponent);
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_sine_or_cosine_beyond_its_bound);
    RUN_TEST(test_sine_or_cosine_wrong_where_its_branches_meet);
    RUN_TEST(test_left_and_right_turns_differ);
    RUN_TEST(test_arctangent_beyond_its_bound);
    RUN_TEST(test_arctangent_wrong_where_its_branches_meet);
    RUN_TEST(test_root_of_a_negative_is_no_number);
    RUN_TEST(test_root_not_correctly_rounded);
    RUN_TEST(test_limit_lets_something_through);
    RUN_TEST(test_raw_rounded_to_even_or_down);
    RUN_TEST(test_raw_wraps_instead_of_saturating);
#if !defined(DIARC_SCALAR_FIXED)
    RUN_TEST(test_raw_of_nan_undefined);
#endif
    RUN_TEST(test_raw_does_not_come_back);
    RUN_TEST(test_parameter_bits_read_inexactly);
    RUN_TEST(test_subnormal_parameter_gets_a_hidden_bit);
    RUN_TEST(test_estimate_told_as_another_number);
    return UNITY_END();
}
