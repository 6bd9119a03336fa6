/* The baseline PID (control/pid). */
#include "control/pid.h"
#include "testing.h"

/* Of a spool, -1..1. */
#define TOLERANCE BY_TYPE(1e-12, 1e-5, 2e-6)

static const double DT_S = 1e-3;
static const struct pid_gains GAINS = {.kp = GAIN(8), .ki = GAIN(10), .kd = GAIN(0.1)};

static struct pid pid;

void setUp(void)
{
    pid = (struct pid){0};
}

void tearDown(void)
{
}

static double step(double e1, double rate)
{
    return real(pid_step(&pid, &GAINS, from_real(e1), from_real(rate), from_real(DT_S)));
}

static void test_error_driven_further(void)
{
    /* GIVEN an arm ahead of its reference WHEN controlled THEN the valve draws it back, and the other way
     * round */
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, -0.01 * (8 + 10 * DT_S), step(0.01, 0));
    setUp();
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, 0.01 * (8 + 10 * DT_S), step(-0.01, 0));
}

static void test_rate_driven_further(void)
{
    /* GIVEN an arm on its reference that runs away WHEN controlled THEN it is braked */
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, -0.02, step(0, 0.2));
}

static void test_lasting_error_not_integrated(void)
{
    /* GIVEN an error of 0.01 rad for 1 s WHEN controlled THEN the spool has grown by ki e t, and stays after
     * it */
    double u = 0;
    for (int k = 0; k < 1000; k++) {
        u = step(0.01, 0);
    }
    TEST_ASSERT_DOUBLE_WITHIN(10 * TOLERANCE, -0.08 - 0.1, u);
    TEST_ASSERT_DOUBLE_WITHIN(10 * TOLERANCE, -0.1, step(0, 0));
}

static void test_spool_beyond_its_limits(void)
{
    /* GIVEN large errors WHEN controlled THEN the spool stays within -1..1 */
    TEST_ASSERT_TRUE(step(0.5, 0) == -1);
    TEST_ASSERT_TRUE(step(-0.5, 0) == 1);
}

static void test_integral_winds_up_at_the_limit(void)
{
    /* GIVEN a valve at its limit for 10 s WHEN the error turns THEN the spool leaves the limit at once */
    for (int k = 0; k < 10000; k++) {
        TEST_ASSERT_TRUE(step(0.2, 0) == -1);
    }
    TEST_ASSERT_TRUE(pid.integral == SCALAR(0));
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, 0.01 * (8 + 10 * DT_S), step(-0.01, 0));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_error_driven_further);
    RUN_TEST(test_rate_driven_further);
    RUN_TEST(test_lasting_error_not_integrated);
    RUN_TEST(test_spool_beyond_its_limits);
    RUN_TEST(test_integral_winds_up_at_the_limit);
    return UNITY_END();
}
