/* The observer of the tracking error's rate (control/observer): 300 rad/s at 1 kHz. */
#include "control/observer.h"
#include "testing.h"

/* rad/s, and of numbers of order one. */
#define TOLERANCE BY_TYPE(1e-12, 2e-6, 1e-5)

static const double DT_S = 1e-3;
static const double BANDWIDTH_RAD_S = 300;

static struct observer_constants constants;

void setUp(void)
{
    constants = observer_constants(gain_from_real(BANDWIDTH_RAD_S), from_real(DT_S));
}

void tearDown(void)
{
}

static void test_growing_error_seen_late(void)
{
    /* GIVEN an error that grows at 0.05 rad/s WHEN observed for 0.1 s THEN error and rate are exact, without
     * lag */
    struct observer observer = observer_at(SCALAR(1e-3));
    double e = 1e-3;
    for (int k = 0; k < 100; k++) {
        e += 0.05 * DT_S;
        observer_step(&observer, &constants, from_real(e), from_real(DT_S));
    }
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, e, real(observer.e));
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE * 10, 0.05, real(observer.w));
}

static void test_observer_starts_with_a_kick(void)
{
    /* GIVEN an error that is constant from the start on WHEN observed THEN its rate is 0 from the first tick
     * on */
    struct observer observer = observer_at(SCALAR(0.01));
    for (int k = 0; k < 10; k++) {
        observer_step(&observer, &constants, SCALAR(0.01), from_real(DT_S));
        TEST_ASSERT_TRUE(observer.w == SCALAR(0));
        TEST_ASSERT_TRUE(observer.e == SCALAR(0.01));
    }
}

/* One tick of the free observer from (e, w): a column of its matrix. */
static struct observer free_step(double e, double w)
{
    struct observer observer = {from_real(e), from_real(w)};
    observer_step(&observer, &constants, SCALAR(0), from_real(DT_S));
    return observer;
}

static void test_bandwidth_is_another(void)
{
    /* GIVEN the range of bandwidths WHEN both columns of the observer's matrix are tried out THEN both its
     * poles are at exp(-bandwidth dt), to the approximation's 2e-3 */
    static const double bandwidth_rad_s[] = {10, 100, 300, 600, 900};
    for (unsigned k = 0; k < COUNT_OF(bandwidth_rad_s); k++) {
        constants = observer_constants(gain_from_real(bandwidth_rad_s[k]), from_real(DT_S));
        const double e = 1.0 / 16; /* the rate is hundreds of times as large */
        const struct observer of_e = free_step(e, 0);
        const struct observer of_w = free_step(0, 1);
        const double trace = real(of_e.e) / e + real(of_w.w);
        const double determinant = (real(of_e.e) * real(of_w.w) - real(of_w.e) * real(of_e.w)) / e;
        const double pole = exp(-bandwidth_rad_s[k] * DT_S);
        TEST_ASSERT_DOUBLE_WITHIN(2e-3, pole, trace / 2);
        /* a double pole: trace^2 = 4 determinant */
        TEST_ASSERT_DOUBLE_WITHIN(10 * TOLERANCE, trace * trace / 4, determinant);
    }
}

static void test_rate_overshoots(void)
{
    /* GIVEN an error at rest that begins to grow WHEN observed THEN its rate rises steadily and never too far
     * */
    struct observer observer = observer_at(SCALAR(0));
    scalar before = SCALAR(0);
    for (int k = 1; k <= 60; k++) {
        observer_step(&observer, &constants, from_real(k * 0.1 * DT_S), from_real(DT_S));
        TEST_ASSERT_TRUE(real(observer.w) >= real(before) - TOLERANCE);
        TEST_ASSERT_TRUE(real(observer.w) <= 0.1 + TOLERANCE);
        before = observer.w;
    }
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 0.1, real(observer.w));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_growing_error_seen_late);
    RUN_TEST(test_observer_starts_with_a_kick);
    RUN_TEST(test_bandwidth_is_another);
    RUN_TEST(test_rate_overshoots);
    return UNITY_END();
}
