/* Fixed point (control/scalar_fixed) against exact integer arithmetic and libm: every claim of its "Scaling and
 * overflow", its error bounds, and what the law's longest chain of products, the UD factors, makes of them. Built
 * for fixed point only. Bounds are measured maxima, rounded up; in steps of the result's last bit where they are. */
#include <stdlib.h>

#include "control/arm_model.h"
#include "control/estimator.h"
#include "testing.h"

/* Absolute; the sine's over every angle there is. */
#define SINE_BOUND 8.3e-8
#define ARCTANGENT_BOUND 6.1e-8      /* when an argument is 2^8 steps or more */
#define ARCTANGENT_BOUND_TINY 2.3e-6 /* of arguments of a few steps */

/* Steps. */
#define PRODUCT_BOUND 0.5
#define QUOTIENT_BOUND 1.0 /* towards zero */
#define ROOT_BOUND 1.0     /* downwards */
#define SHARE_BOUND 1.02
#define RATIO_BOUND 1.02
#define INVERSE_BOUND 0x1.8p-30 /* relative */

/* Of the variances over 2,000 updates of an arm that moves to and fro: relative, and 107 steps of 2^-30. */
#define COVARIANCE_RELATIVE 0.03
#define COVARIANCE_ABSOLUTE 1e-7

/* A quarter of the word's range. */
#define QUARTER 536870912

enum { RANDOM = 1000000 };

static struct lcg noise;

void setUp(void)
{
    noise = (struct lcg){20240607};
}

void tearDown(void)
{
}

static const int32_t CORNERS[] = {
    0,        1,       2,           3,       4095,        65536,   1 << 23,       (1 << 24) - 1, 1 << 24,
    12345678, 1 << 28, QUARTER - 1, QUARTER, QUARTER + 1, 1 << 30, INT32_MAX - 1, INT32_MAX,
};

/* A corner, or a number of any size, of either sign. */
static int32_t any_word(void)
{
    const double kind = lcg_uniform(&noise, 0, 3);
    int32_t magnitude;
    if (kind < 1) {
        magnitude = CORNERS[(unsigned)lcg_uniform(&noise, 0, COUNT_OF(CORNERS))];
    } else if (kind < 2) {
        magnitude = (int32_t)exp(lcg_uniform(&noise, 0, log(2147483647.0)));
    } else {
        magnitude = (int32_t)lcg_uniform(&noise, 0, 2147483647.0);
    }
    return lcg_uniform(&noise, 0, 1) < 0.5 ? -magnitude : magnitude;
}

/* ---- products and quotients ---- */

static void test_limit_is_not_a_quarter_of_the_range(void)
{
    /* GIVEN the limit of products and quotients WHEN taken as a number THEN 32 for a scalar, 2048 for a gain, 0.5
     * for a variance, to a step */
    TEST_ASSERT_INT32_WITHIN(1, QUARTER, FIXED_LIMIT);
    TEST_ASSERT_DOUBLE_WITHIN(0x1p-24, 32, real(FIXED_LIMIT));
    TEST_ASSERT_DOUBLE_WITHIN(0x1p-18, 2048, real_gain(FIXED_LIMIT));
    TEST_ASSERT_DOUBLE_WITHIN(0x1p-30, 0.5, real_variance(FIXED_LIMIT));
}

static void test_four_products_at_their_limit_overflow_when_added(void)
{
    /* GIVEN four products or quotients at their limit, of either sign WHEN added with a plain + THEN they fit into
     * the word */
    TEST_ASSERT_TRUE(4 * (int64_t)FIXED_LIMIT <= INT32_MAX);
    TEST_ASSERT_TRUE(-4 * ((int64_t)FIXED_LIMIT + 1) >= INT32_MIN);
    const scalar most = mul(SCALAR(30), SCALAR(30));
    const scalar sum = most + most + most + most;
    TEST_ASSERT_DOUBLE_WITHIN(4 * 256 * STEP, 128, real(sum));
    const scalar least = quot(SCALAR(-30), SCALAR(0.1));
    const scalar other_sum = least + least + least + least;
    TEST_ASSERT_DOUBLE_WITHIN(4 * STEP, -128, real(other_sum));
}

static void expect_product(int32_t a, int32_t b, uint8_t shift, int32_t product)
{
    const int64_t exact = (int64_t)a * b;
    const int64_t half_up = (exact >> shift) + ((exact >> (shift - 1)) & 1);
    if (llabs(half_up) > FIXED_LIMIT) { /* only the high word is at the limit */
        const int64_t below = (int64_t)FIXED_LIMIT + 1 - (half_up > 0 ? product : -(int64_t)product);
        TEST_ASSERT_TRUE(below >= 0 && below <= (int64_t)1 << (32 - shift));
    } else {
        TEST_ASSERT_EQUAL_INT32((int32_t)half_up, (int32_t)product);
        const long double error = (long double)product - ldexpl((long double)exact, -shift);
        TEST_ASSERT_DOUBLE_WITHIN(PRODUCT_BOUND, 0, (double)error);
    }
}

static void expect_products(int32_t a, int32_t b)
{
    expect_product(a, b, SCALAR_FRACTION, mul(a, b));
    expect_product(a, b, GAIN_FRACTION, amp(a, b));
}

static void test_product_wraps_or_is_rounded_another_way(void)
{
    /* GIVEN words of every size and sign, the ends among them WHEN multiplied THEN rounded half up, at the limit where
     * the exact product is beyond it, never wrapped */
    for (unsigned n = 0; n < COUNT_OF(CORNERS); n++) {
        for (unsigned k = 0; k < COUNT_OF(CORNERS); k++) {
            expect_products(CORNERS[n], CORNERS[k]);
            expect_products(-CORNERS[n], CORNERS[k]);
            expect_products(-CORNERS[n], -CORNERS[k]);
        }
    }
    for (int n = 0; n < 2 * RANDOM; n++) {
        expect_products(any_word(), any_word());
    }
}

static void test_sum_of_products_wraps_or_is_rounded_more_than_once(void)
{
    /* GIVEN sums of sixteen products of words up to the limit of products, and a word WHEN narrowed THEN the exact sum
     * rounded half up once, at half of the range where it is beyond it, never wrapped */
    for (int n = 0; n < RANDOM; n++) {
        const double size = exp(lcg_uniform(&noise, 0, log(QUARTER)));
        const scalar start = any_word();
        wide sum = wide_of(start);
        int64_t exact = (int64_t)start * (1 << SCALAR_FRACTION);
        for (int k = 0; k < 16; k++) {
            const scalar a = (scalar)lcg_uniform(&noise, -size, size);
            const scalar b = (scalar)lcg_uniform(&noise, -QUARTER, QUARTER);
            sum = k % 2 == 0 ? add_product(sum, a, b) : subtract_product(sum, a, b);
            exact += (k % 2 == 0 ? 1 : -1) * (int64_t)a * b;
        }
        const int64_t half_up = (exact + (1 << (SCALAR_FRACTION - 1))) >> SCALAR_FRACTION;
        const int64_t half = (int64_t)1 << 30;
        if (half_up >= -half && half_up < half) {
            TEST_ASSERT_EQUAL_INT32((int32_t)half_up, narrow(sum));
        } else { /* only the high word is at the limit */
            const int64_t below = half - (half_up > 0 ? narrow(sum) : -(int64_t)narrow(sum));
            TEST_ASSERT_TRUE(below >= 0 && below <= 1 << (32 - SCALAR_FRACTION));
        }
    }
}

static void test_product_turns_its_sign_at_the_limit(void)
{
    /* GIVEN factors that grow WHEN multiplied THEN the product grows to the limit and stays there, but for what the low
     * word holds, the same on both sides */
    const int32_t low_word = 1 << (32 - SCALAR_FRACTION);
    scalar before = SCALAR(0);
    for (double x = 0; x < 127; x += 0.01) {
        const scalar up = mul(from_real(x), SCALAR(3));
        const scalar down = mul(from_real(-x), SCALAR(3));
        TEST_ASSERT_TRUE(up >= before - low_word);
        TEST_ASSERT_INT32_WITHIN(x < 10.6 ? 1 : low_word, 0, up + down); /* half up is not half away */
        TEST_ASSERT_TRUE(up <= FIXED_LIMIT);
        before = up;
    }
    TEST_ASSERT_INT32_WITHIN(low_word, FIXED_LIMIT, mul(SCALAR(127), SCALAR(127)));
    TEST_ASSERT_INT32_WITHIN(low_word, -FIXED_LIMIT, mul(SCALAR(-127), SCALAR(127)));
    TEST_ASSERT_INT32_WITHIN(low_word, FIXED_LIMIT, mul(INT32_MAX, INT32_MAX));
    TEST_ASSERT_INT32_WITHIN(low_word, -FIXED_LIMIT, mul(-INT32_MAX, INT32_MAX));
    TEST_ASSERT_INT32_WITHIN(low_word, FIXED_LIMIT, mul(INT32_MIN, INT32_MIN));
    const int32_t low_word_of_gain = 1 << (32 - GAIN_FRACTION);
    TEST_ASSERT_INT32_WITHIN(low_word_of_gain, -FIXED_LIMIT, amp(GAIN(8000), SCALAR(-1)));
    TEST_ASSERT_INT32_WITHIN(low_word_of_gain, FIXED_LIMIT, amp(GAIN(8000), SCALAR(1)));
    TEST_ASSERT_DOUBLE_WITHIN(STEP, 8, real(amp(GAIN(8000), SCALAR(0.001))) / real(SCALAR(0.001)) * 0.001);
}

static void expect_quotient(int32_t a, int32_t b, uint8_t shift)
{
    const int32_t result = fixed_quotient(a, b, shift, FIXED_LIMIT);
    const long double exact = ldexpl((long double)a, shift) / (long double)b;
    if (fabsl(exact) >= FIXED_LIMIT) {
        TEST_ASSERT_EQUAL_INT32(exact > 0 ? FIXED_LIMIT : -FIXED_LIMIT, result);
        return;
    }
    TEST_ASSERT_TRUE(fabsl(result - exact) < (long double)QUOTIENT_BOUND);
    TEST_ASSERT_EQUAL_INT32(-result, fixed_quotient(-a, b, shift, FIXED_LIMIT));
    TEST_ASSERT_EQUAL_INT32(-result, fixed_quotient(a, -b, shift, FIXED_LIMIT));
}

static void test_quotient_wraps_or_leaves_its_bound(void)
{
    /* GIVEN words of every size and sign, the ends among them WHEN divided THEN within the bound, symmetrical, at
     * the limit where the exact quotient is beyond it */
    static const uint8_t shifts[] = {SCALAR_FRACTION, GAIN_FRACTION, 29};
    for (unsigned s = 0; s < COUNT_OF(shifts); s++) {
        for (unsigned n = 0; n < COUNT_OF(CORNERS); n++) {
            for (unsigned k = 1; k < COUNT_OF(CORNERS); k++) {
                expect_quotient(CORNERS[n], CORNERS[k], shifts[s]);
                expect_quotient(-CORNERS[n], CORNERS[k], shifts[s]);
            }
        }
        for (int n = 0; n < RANDOM; n++) {
            const int32_t b = any_word();
            expect_quotient(any_word(), b != 0 ? b : 1, shifts[s]);
        }
    }
    for (int n = 0; n < RANDOM; n++) {
        const int32_t a = any_word();
        const int32_t b = any_word() | 1;
        const double exact = (double)a / b * SCALAR(1);
        if (fabs(exact) < FIXED_LIMIT - 2) {
            TEST_ASSERT_DOUBLE_WITHIN(1.01 + fabs(exact) * 0x1p-29, exact, quot(a, b));
        } else if (fabs(exact) > FIXED_LIMIT + 2.0) {
            TEST_ASSERT_EQUAL_INT32(exact > 0 ? FIXED_LIMIT : -FIXED_LIMIT, quot(a, b));
        }
    }
    TEST_ASSERT_EQUAL_INT32(FIXED_LIMIT, quot(INT32_MIN, -1));
    TEST_ASSERT_EQUAL_INT32(-FIXED_LIMIT, quot(INT32_MIN, 1));
}

static void test_quotient_by_nothing_traps(void)
{
    /* GIVEN a divisor that vanished WHEN divided THEN the limit with the dividend's sign */
    TEST_ASSERT_EQUAL_INT32(FIXED_LIMIT, quot(SCALAR(1), SCALAR(0)));
    TEST_ASSERT_EQUAL_INT32(FIXED_LIMIT, quot(SCALAR(0), SCALAR(0)));
    TEST_ASSERT_EQUAL_INT32(-FIXED_LIMIT, quot(-1, SCALAR(0)));
    TEST_ASSERT_TRUE(gain_quot(SCALAR(-3), SCALAR(0)) <= -FIXED_LIMIT);
}

static void test_fraction_of_counts_wrong(void)
{
    /* GIVEN counts of every size, part <= whole < 2^31 WHEN taken as a fraction THEN within the bound of a
     * quotient, and 0 and 1 exactly at the ends */
    for (int n = 0; n < RANDOM; n++) {
        const uint32_t whole = (uint32_t)exp(lcg_uniform(&noise, 0, log(2147483647.0)));
        const uint32_t part = (uint32_t)lcg_uniform(&noise, 0, whole);
        const double exact = (double)part / whole * 0x1p24;
        TEST_ASSERT_TRUE(fabs(fraction(part, whole) - exact) < QUOTIENT_BOUND);
        TEST_ASSERT_EQUAL_INT32(0, fraction(0, whole));
        TEST_ASSERT_EQUAL_INT32(SCALAR(1), fraction(whole, whole));
    }
    TEST_ASSERT_EQUAL_INT32(SCALAR(1), fraction(INT32_MAX, INT32_MAX));
    TEST_ASSERT_INT32_WITHIN(1, SCALAR(1), fraction(INT32_MAX - 1, INT32_MAX));
}

/* ---- functions ---- */

static void test_sine_or_cosine_of_any_angle_beyond_its_bound(void)
{
    /* GIVEN every seventh angle of two turns, and all within 64 steps of a multiple of a quarter turn WHEN compared
     * with libm THEN the error is below the bound and the magnitude at most one step above 1 */
    const int32_t last = SCALAR(2 * PI_REAL) - 1;
    for (int32_t x = -last; x <= last;) {
        TEST_ASSERT_DOUBLE_WITHIN(SINE_BOUND, sin(real(x)), real(sine(x)));
        TEST_ASSERT_DOUBLE_WITHIN(SINE_BOUND, cos(real(x)), real(cosine(x)));
        TEST_ASSERT_TRUE(absolute(sine(x)) <= SCALAR(1) + 1);
        const double from_quarter = remainder(real(x), PI_REAL / 2) * 0x1p24;
        x += fabs(from_quarter) < 64 ? 1 : 7;
    }
}

static void test_arctangent_of_any_ratio_beyond_its_bound(void)
{
    /* GIVEN pairs of every size up to the limit of products WHEN compared with libm THEN the error is below the
     * bound; below 2^8 steps, where no branch fits well, below the other */
    for (int n = 0; n < 4 * RANDOM; n++) {
        const int32_t large = (int32_t)exp(lcg_uniform(&noise, 0, log(QUARTER)));
        const int32_t other = n % 4 < 2 ? (int32_t)lcg_uniform(&noise, 1, large + 1.0)
                                        : (int32_t)exp(lcg_uniform(&noise, 0, log(large + 1.0)));
        const scalar x = n % 2 == 0 ? large : other;
        const scalar y = n % 2 == 0 ? other : large;
        const double bound = large < 256 ? ARCTANGENT_BOUND_TINY : ARCTANGENT_BOUND;
        TEST_ASSERT_DOUBLE_WITHIN(bound, atan2(y, x), real(arctangent(y, x)));
        TEST_ASSERT_EQUAL_INT32(-arctangent(y, x), arctangent(-y, x));
    }
    for (int32_t x = 1; x < 300; x++) {
        for (int32_t y = 0; y < 300; y++) {
            TEST_ASSERT_DOUBLE_WITHIN(ARCTANGENT_BOUND_TINY, atan2(y, x), real(arctangent(y, x)));
        }
    }
}

static void test_root_too_large_or_too_small(void)
{
    /* GIVEN numbers of every size WHEN rooted THEN the largest number whose square is no more */
    for (int n = 0; n < RANDOM; n++) {
        const scalar x = absolute(any_word());
        const int64_t r = root(x);
        const int64_t square = (int64_t)x << 24;
        TEST_ASSERT_TRUE(r * r <= square);
        TEST_ASSERT_TRUE((r + 1) * (r + 1) > square);
        TEST_ASSERT_TRUE(fabs(real(root(x)) - sqrt(real(x))) < ROOT_BOUND * STEP);
    }
    TEST_ASSERT_EQUAL_INT32(SCALAR(1), root(SCALAR(1)));
    TEST_ASSERT_EQUAL_INT32(1 << 12, root(1));
}

/* ---- raw values and parameters ---- */

static void test_raw_beyond_the_range_wraps(void)
{
    /* GIVEN raw values whose number is beyond the limit of products WHEN decoded THEN the limit, and below it
     * exact */
    TEST_ASSERT_EQUAL_INT32(SCALAR(31), scalar_from_raw(31, 0));
    TEST_ASSERT_EQUAL_INT32(-SCALAR(31), scalar_from_raw(-31, 0));
    TEST_ASSERT_EQUAL_INT32(FIXED_LIMIT, scalar_from_raw(33, 0));
    TEST_ASSERT_EQUAL_INT32(-FIXED_LIMIT, scalar_from_raw(-33, 0));
    TEST_ASSERT_EQUAL_INT32(FIXED_LIMIT, scalar_from_raw(INT32_MAX, 0));
    TEST_ASSERT_EQUAL_INT32(-FIXED_LIMIT, scalar_from_raw(-INT32_MAX, 0));
    TEST_ASSERT_EQUAL_INT32(FIXED_LIMIT, scalar_from_raw(INT32_MAX, 24));
    TEST_ASSERT_EQUAL_INT32(SCALAR(1), scalar_from_raw(INT32_MAX, 31)); /* rounded */
    TEST_ASSERT_EQUAL_INT32(-SCALAR(1), scalar_from_raw(-INT32_MAX, 31));
    for (uint8_t bits = 0; bits <= 31u; bits++) {
        for (int n = 0; n < 20000; n++) {
            const int32_t raw = any_word();
            const double exact = ldexp(raw, 24 - bits);
            const double expected = fmax(fmin(floor(exact + 0.5), FIXED_LIMIT), -FIXED_LIMIT);
            TEST_ASSERT_EQUAL_INT32((int32_t)expected, scalar_from_raw(raw, bits));
        }
    }
}

static void test_raw_of_a_number_wrong(void)
{
    /* GIVEN numbers of every size and every count of fraction bits WHEN encoded THEN to the nearest, halves away
     * from zero, and at the ends where they are beyond them */
    for (uint8_t bits = 0; bits <= 31u; bits++) {
        for (int n = 0; n < 20000; n++) {
            const scalar x = any_word();
            const double exact = ldexp(x, bits - 24);
            const double low = n % 2 == 0 ? INT32_MIN : -8388607;
            const double high = n % 2 == 0 ? INT32_MAX : 8388607;
            const double expected = fmax(fmin(round(exact), high), low);
            TEST_ASSERT_EQUAL_INT32((int32_t)expected, scalar_to_raw(x, bits, (int32_t)low, (int32_t)high));
        }
    }
}

static void test_parameter_of_any_bits_wrong(void)
{
    /* GIVEN random binary32 numbers and exponents WHEN read THEN to the nearest, halves away from zero, mirrored, and
     * at the ends of the whole word */
    for (int n = 0; n < RANDOM; n++) {
        const uint32_t sign = n % 2 == 0 ? 0u : 0x80000000u;
        const int8_t exponent = (int8_t)lcg_uniform(&noise, -96, 97);
        /* half of them of a size that fixed point can hold */
        const double stored =
            n % 4 < 2 ? lcg_uniform(&noise, 0, 255) : lcg_uniform(&noise, 95, 140) + exponent;
        const uint32_t biased = (uint32_t)fmin(fmax(stored, 0), 254);
        const uint32_t bits = sign | biased << 23 | (uint32_t)lcg_uniform(&noise, 0, 1 << 23);
        float value;
        memcpy(&value, &bits, sizeof value);
        const double per_unit_value = ldexp((double)value, -exponent);
        const double word = 2147483647;
        TEST_ASSERT_EQUAL_INT32((int32_t)fmax(fmin(round(per_unit_value * 0x1p24), word), -word),
                                scalar_from_real32(bits, exponent));
        TEST_ASSERT_EQUAL_INT32((int32_t)fmax(fmin(round(per_unit_value * 0x1p18), word), -word),
                                gain_from_real32(bits, exponent));
    }
}

/* ---- variances ---- */

static variance any_variance(void)
{
    const double kind = lcg_uniform(&noise, 0, 3);
    const double v =
        kind < 1 ? lcg_uniform(&noise, 1, 2147483647.0) : exp(lcg_uniform(&noise, 0, log(QUARTER)));
    return v < 1 ? 1 : (variance)v;
}

static void test_inverse_of_a_variance_beyond_its_bound(void)
{
    /* GIVEN 10^5 variances from one step to the end of the word WHEN inverted THEN too small by at most 1.5 * 2^-30 of
     * it */
    for (int n = 0; n < 100000; n++) {
        const variance v = n == 0 ? 1 : n == 1 ? INT32_MAX : n < 32 ? (variance)1 << (n - 1) : any_variance();
        const inverse i = invert(v);
        const long double inverted = ldexpl((long double)i.mantissa, i.shift - 32);
        const long double off = inverted * v * 0x1p-30L - 1;
        TEST_ASSERT_TRUE(off <= 0);
        TEST_ASSERT_TRUE(off >= (long double)-INVERSE_BOUND);
        TEST_ASSERT_TRUE(i.mantissa >= 1 << 30);
    }
}

static void test_ratio_or_share_of_variances_beyond_its_bound(void)
{
    /* GIVEN 10^5 pairs of variances, the first of either sign WHEN divided through the inverse THEN the ratio is
     * right to a step and the inverse's bound, the share to its bound and never above 1; a ratio beyond 2048 is
     * there */
    for (int n = 0; n < 100000; n++) {
        const variance whole = any_variance();
        const variance magnitude = any_variance();
        const variance part = n % 2 == 0 ? magnitude : -magnitude;
        const inverse i = invert(whole);
        const double exact = (double)part / whole;
        const double ratio = real_gain(variance_ratio(part, i));
        if (fabs(exact) < 2047) {
            TEST_ASSERT_DOUBLE_WITHIN(RATIO_BOUND * 0x1p-18 + fabs(exact) * INVERSE_BOUND, exact, ratio);
        } else if (fabs(exact) > 2049) {
            TEST_ASSERT_DOUBLE_WITHIN(0x1p-18, exact > 0 ? 2048 : -2048, ratio);
        }
        if (fabs(exact) <= 1) {
            TEST_ASSERT_DOUBLE_WITHIN(SHARE_BOUND * STEP, exact, real(variance_share(part, i)));
            TEST_ASSERT_TRUE(absolute(variance_share(part, i)) <= SCALAR(1));
            const scalar of_magnitude = variance_part(absolute(part), i);
            TEST_ASSERT_DOUBLE_WITHIN(SHARE_BOUND * STEP, fabs(exact), real(of_magnitude));
            TEST_ASSERT_TRUE(of_magnitude <= SCALAR(1));
        }
    }
    TEST_ASSERT_EQUAL_INT32(SCALAR(1), variance_share(VARIANCE(0.3), invert(VARIANCE(0.3))));
}

static void test_standard_deviation_is_not_the_root_of_its_variance(void)
{
    /* GIVEN variances of every size WHEN rooted THEN the largest number whose square is no more, 0 for none or
     * less; WHEN squared again THEN the same deviation to what the variance's steps allow */
    for (int n = 0; n < 100000; n++) {
        const variance v = any_variance();
        const int64_t sd = sd_of(v);
        const int64_t square = (int64_t)v << 18;
        TEST_ASSERT_TRUE(sd * sd <= square);
        TEST_ASSERT_TRUE((sd + 1) * (sd + 1) > square);
    }
    TEST_ASSERT_EQUAL_INT32(0, sd_of(VARIANCE(0)));
    TEST_ASSERT_EQUAL_INT32(0, sd_of(-1));
    TEST_ASSERT_EQUAL_INT32(SCALAR(0.5), sd_of(VARIANCE(0.25)));
    for (double sd = 1e-4; sd < 0.7; sd *= 1.01) {
        const scalar s = from_real(sd);
        const double half_step = 0x1p-31 / (2 * sd); /* of the variance, as one of the deviation */
        TEST_ASSERT_DOUBLE_WITHIN(1.01 * half_step + ROOT_BOUND * STEP, real(s), real(sd_of(variance_of(s))));
    }
}

static void test_variance_of_a_deviation_within_its_contract_saturates(void)
{
    /* GIVEN deviations up to 1, as the contract has it WHEN squared THEN their square */
    for (double sd = -1; sd <= 1; sd += 0.05) {
        TEST_ASSERT_DOUBLE_WITHIN(2e-7, sd * sd, real_variance(variance_of(from_real(sd))));
    }
}

/* ---- the estimator's covariance ---- */

/* The reference arm moves to and fro: the regressors of its rows in units of the ranges. */
static void moving_row(const struct machine *machine, const struct estimator_constants *constants, int n,
                       scalar phi[THETA_M])
{
    const double t = n * 0.004;
    const scalar q2 = from_real(0.1 + 0.4 * sin(1.9 * t));
    const scalar w[JOINTS] = {from_real(0.6 * cos(1.3 * t)), from_real(0.4 * 1.9 * cos(1.9 * t))};
    const scalar a[JOINTS] = {from_real(-0.6 * 1.3 * sin(1.3 * t)),
                              from_real(-0.4 * 1.9 * 1.9 * sin(1.9 * t))};
    const enum joint i = (enum joint)(n % JOINTS);
    const struct wrist_trig trig = wrist_trig(&machine->arm, q2);
    struct arm_row row;
    arm_inverse_dynamics(&machine->arm, &trig, i, w, a, coulomb_sign(&machine->arm, w[i]), SCALAR(1), &row);
    for (uint8_t k = 0; k < THETA_M; k++) {
        phi[k] = SCALAR(0);
    }
    for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
        phi[row_parameter(i, k)] = mul(row.phi[k], constants->scale_m[row_parameter(i, k)]);
    }
}

static void covariance_update(double P[THETA_M][THETA_M], const scalar phi[], double noise_variance,
                              double K[])
{
    double P_phi[THETA_M] = {0};
    double alpha = noise_variance;
    for (uint8_t i = 0; i < THETA_M; i++) {
        for (uint8_t j = 0; j < THETA_M; j++) {
            P_phi[i] += P[i][j] * real(phi[j]);
        }
        alpha += real(phi[i]) * P_phi[i];
    }
    for (uint8_t i = 0; i < THETA_M; i++) {
        K[i] = P_phi[i] / alpha;
        for (uint8_t j = 0; j < THETA_M; j++) {
            P[i][j] -= P_phi[i] * P_phi[j] / alpha;
        }
    }
}

static void test_factor_turns_its_sign_at_the_end_of_the_word(void)
{
    /* GIVEN rows that hardly differ and say much more than the priors, K still below its limit WHEN updated THEN no
     * factor of U ever moves by more than a product can */
    for (int n = 0; n < 500; n++) {
        struct ud_factors ud;
        variance prior[UD_SIZE_MAX];
        scalar direction[UD_SIZE_MAX];
        for (uint8_t k = 0; k < UD_SIZE_MAX; k++) {
            prior[k] = VARIANCE(0.2);
            direction[k] = from_real(lcg_uniform(&noise, -0.9, 0.9));
        }
        ud_start(&ud, UD_SIZE_MAX, prior);
        for (int m = 0; m < 30; m++) {
            scalar phi[UD_SIZE_MAX];
            gain K[UD_SIZE_MAX];
            for (uint8_t k = 0; k < UD_SIZE_MAX; k++) {
                phi[k] = direction[k] + from_real(lcg_uniform(&noise, -1e-3, 1e-3));
            }
            const struct ud_factors before = ud;
            (void)ud_update(&ud, phi, VARIANCE(0.2e-6), K);
            for (uint8_t k = 0; k < UD_OFF_DIAGONAL; k++) {
                TEST_ASSERT_DOUBLE_WITHIN(32, real(before.U[k]), real(ud.U[k]));
            }
        }
    }
}

static void test_innovation_of_wide_open_priors_turns_negative(void)
{
    /* GIVEN six parameters whose priors are open over two thirds of their ranges, in a row of order one WHEN updated
     * THEN the innovation's variance is at least any one's share of it, and D is none below 0 */
    static const variance prior[6] = {VARIANCE(0.45), VARIANCE(0.45), VARIANCE(0.45),
                                      VARIANCE(0.45), VARIANCE(0.45), VARIANCE(0.45)};
    static const scalar phi[6] = {SCALAR(1), SCALAR(1), SCALAR(1), SCALAR(1), SCALAR(1), SCALAR(1)};
    struct ud_factors ud;
    gain K[UD_SIZE_MAX];
    ud_start(&ud, 6, prior);
    TEST_ASSERT_TRUE(ud_update(&ud, phi, VARIANCE(0.001), K) >= VARIANCE(0.45));
    for (uint8_t k = 0; k < 6u; k++) {
        TEST_ASSERT_TRUE(ud.D[k] >= 0);
        TEST_ASSERT_TRUE(ud.D[k] <= prior[k]);
    }
}

static void test_covariance_of_a_moving_arm_lost(void)
{
    /* GIVEN the reference arm's priors and noise WHEN it moves for 2,000 updates, its load walking THEN D never is
     * negative, and every variance is that of the covariance form in double within the bound */
    struct machine machine;
    struct bases bases;
    load_reference_arm(&machine, &bases);
    struct estimator_constants constants;
    estimator_constants(&constants, &machine.estimator, SCALAR(1e-3));
    static struct estimator estimator;
    estimator_start(&estimator, &machine.estimator, &constants);
    struct ud_factors *const ud = &estimator.covariance_m;
    double P[THETA_M][THETA_M] = {{0}};
    for (uint8_t k = 0; k < THETA_M; k++) {
        P[k][k] = real_variance(ud->D[k]);
    }
    for (int n = 0; n < 2000; n++) {
        scalar phi[THETA_M];
        gain K[THETA_M];
        double expected_K[THETA_M];
        moving_row(&machine, &constants, n, phi);
        if (n % 50 == 0) {
            ud->D[M_T] += constants.walk;
            P[M_T][M_T] += real_variance(constants.walk);
        }
        const variance of_noise = constants.noise_m[n % JOINTS];
        covariance_update(P, phi, real_variance(of_noise), expected_K);
        (void)ud_update(ud, phi, of_noise, K);
        for (uint8_t k = 0; k < THETA_M; k++) {
            TEST_ASSERT_TRUE(ud->D[k] >= 0);
            const double bound = COVARIANCE_RELATIVE * P[k][k] + COVARIANCE_ABSOLUTE;
            TEST_ASSERT_DOUBLE_WITHIN(bound, P[k][k], real_variance(ud_variance(ud, k)));
        }
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_limit_is_not_a_quarter_of_the_range);
    RUN_TEST(test_four_products_at_their_limit_overflow_when_added);
    RUN_TEST(test_product_wraps_or_is_rounded_another_way);
    RUN_TEST(test_sum_of_products_wraps_or_is_rounded_more_than_once);
    RUN_TEST(test_product_turns_its_sign_at_the_limit);
    RUN_TEST(test_quotient_wraps_or_leaves_its_bound);
    RUN_TEST(test_quotient_by_nothing_traps);
    RUN_TEST(test_fraction_of_counts_wrong);
    RUN_TEST(test_sine_or_cosine_of_any_angle_beyond_its_bound);
    RUN_TEST(test_arctangent_of_any_ratio_beyond_its_bound);
    RUN_TEST(test_root_too_large_or_too_small);
    RUN_TEST(test_raw_beyond_the_range_wraps);
    RUN_TEST(test_raw_of_a_number_wrong);
    RUN_TEST(test_parameter_of_any_bits_wrong);
    RUN_TEST(test_inverse_of_a_variance_beyond_its_bound);
    RUN_TEST(test_ratio_or_share_of_variances_beyond_its_bound);
    RUN_TEST(test_standard_deviation_is_not_the_root_of_its_variance);
    RUN_TEST(test_variance_of_a_deviation_within_its_contract_saturates);
    RUN_TEST(test_factor_turns_its_sign_at_the_end_of_the_word);
    RUN_TEST(test_innovation_of_wide_open_priors_turns_negative);
    RUN_TEST(test_covariance_of_a_moving_arm_lost);
    return UNITY_END();
}
