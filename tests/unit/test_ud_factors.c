/* The UD factors (control/ud_factors) against the covariance form of the same least squares, in double. */
#include "control/ud_factors.h"
#include "testing.h"

/* Of variances and gains of order one, over some hundred updates. */
#if defined(DIARC_SCALAR_DOUBLE)
#define TOLERANCE 1e-10
#else
#define TOLERANCE 2e-4
#endif

enum { SIZE = UD_SIZE_MAX };

static struct lcg noise;
static struct ud_factors ud;
static double P[SIZE][SIZE]; /* the covariance form */

void setUp(void)
{
    noise = (struct lcg){20240607};
}

void tearDown(void)
{
}

static void start(uint8_t size, const double variance[])
{
    scalar v[SIZE] = {0};
    memset(P, 0, sizeof P);
    for (uint8_t k = 0; k < size; k++) {
        v[k] = SCALAR(variance[k]);
        P[k][k] = real(v[k]);
    }
    ud_start(&ud, size, v);
}

static void random_row(uint8_t size, double amplitude, scalar phi[SIZE])
{
    for (uint8_t k = 0; k < size; k++) {
        phi[k] = SCALAR(lcg_uniform(&noise, -amplitude, amplitude));
    }
}

/* P - K phi'P, K = P phi / (1 + phi'P phi) */
static double covariance_update(uint8_t size, const scalar phi[SIZE], double K[SIZE])
{
    double P_phi[SIZE] = {0};
    double alpha = 1;
    for (uint8_t i = 0; i < size; i++) {
        for (uint8_t j = 0; j < size; j++) {
            P_phi[i] += P[i][j] * real(phi[j]);
        }
        alpha += real(phi[i]) * P_phi[i];
    }
    for (uint8_t i = 0; i < size; i++) {
        K[i] = P_phi[i] / alpha;
        for (uint8_t j = 0; j < size; j++) {
            P[i][j] -= K[i] * P_phi[j];
        }
    }
    return alpha;
}

/* P(i,j) out of the factors. */
static double product(uint8_t i, uint8_t j)
{
    double sum = 0;
    for (uint8_t k = i > j ? i : j; k < ud.size; k++) {
        const double Uik = i == k ? 1 : real(ud.U[k * (k - 1) / 2 + i]);
        const double Ujk = j == k ? 1 : real(ud.U[k * (k - 1) / 2 + j]);
        sum += Uik * real(ud.D[k]) * Ujk;
    }
    return sum;
}

static void expect_covariance(void)
{
    for (uint8_t k = 0; k < ud.size; k++) {
        TEST_ASSERT_TRUE(ud.D[k] >= SCALAR(0)); /* false for NaN too */
        TEST_ASSERT_TRUE(ud.D[k] <= SCALAR(1e6));
    }
}

static void test_one_parameter_by_hand(void)
{
    /* GIVEN variance 4 WHEN measured once with phi = 1 THEN innovation 5, gain 0.8, variance 0.8 */
    const double variance[] = {4};
    const scalar phi[SIZE] = {SCALAR(1)};
    scalar K[SIZE];
    start(1, variance);
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 5, real(ud_update(&ud, phi, K)));
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0.8, real(K[0]));
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0.8, real(ud_variance(&ud, 0)));
}

static void test_factors_drift_from_the_covariance_form(void)
{
    /* GIVEN random rows and every size WHEN updated THEN gain, innovation and P are the covariance form's */
    for (uint8_t size = 1; size <= SIZE; size++) {
        double variance[SIZE];
        for (uint8_t k = 0; k < size; k++) {
            variance[k] = lcg_uniform(&noise, 0.1, 2);
        }
        start(size, variance);
        for (int n = 0; n < 200; n++) {
            scalar phi[SIZE] = {0};
            scalar K[SIZE];
            double expected_K[SIZE];
            random_row(size, 1, phi);
            const double alpha = covariance_update(size, phi, expected_K);
            TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE * alpha, alpha, real(ud_update(&ud, phi, K)));
            for (uint8_t i = 0; i < size; i++) {
                TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, expected_K[i], real(K[i]));
                TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, P[i][i], real(ud_variance(&ud, i)));
                for (uint8_t j = 0; j < size; j++) {
                    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, P[i][j], product(i, j));
                }
            }
        }
    }
}

static void test_estimate_does_not_reach_the_truth(void)
{
    /* GIVEN exact measurements WHEN theta += K (y - phi' theta) THEN theta is found, with little variance */
    static const double truth[] = {0.4, -0.2, 0.7, 0.1, -0.6, 0.3, 0.05, -0.9, 0.5};
    static const double variance[] = {1, 1, 1, 1, 1, 1, 1, 1, 1};
    double theta[SIZE] = {0};
    start(SIZE, variance);
    for (int n = 0; n < 5000; n++) {
        scalar phi[SIZE];
        scalar K[SIZE];
        random_row(SIZE, 3, phi);
        double residual = 0;
        for (uint8_t k = 0; k < SIZE; k++) {
            residual += real(phi[k]) * (truth[k] - theta[k]);
        }
        (void)ud_update(&ud, phi, K);
        for (uint8_t k = 0; k < SIZE; k++) {
            theta[k] += real(K[k]) * residual;
        }
    }
    for (uint8_t k = 0; k < SIZE; k++) {
        TEST_ASSERT_DOUBLE_WITHIN(1e-3, truth[k], theta[k]);
        TEST_ASSERT_DOUBLE_WITHIN(1e-4, 0, real(ud_variance(&ud, k)));
    }
}

static void test_pinned_parameter_moves(void)
{
    /* GIVEN one parameter of zero variance, whichever WHEN others learn THEN its gain and variance are 0 */
    for (uint8_t pinned = 0; pinned < SIZE; pinned++) {
        double variance[SIZE];
        for (uint8_t k = 0; k < SIZE; k++) {
            variance[k] = k == pinned ? 0 : 1;
        }
        start(SIZE, variance);
        for (int n = 0; n < 300; n++) {
            scalar phi[SIZE];
            scalar K[SIZE];
            random_row(SIZE, 5, phi);
            (void)ud_update(&ud, phi, K);
            TEST_ASSERT_TRUE(K[pinned] == SCALAR(0));
            TEST_ASSERT_TRUE(ud_variance(&ud, pinned) == SCALAR(0));
        }
    }
}

static void test_walk_of_the_load_spreads_to_others(void)
{
    /* GIVEN correlated parameters WHEN D[0] grows THEN P(0,0) grows by as much and nothing else moves */
    static const double variance[] = {1, 0.5, 2, 1, 0.3, 1, 1.5, 1, 0.7};
    start(SIZE, variance);
    for (int n = 0; n < 50; n++) {
        scalar phi[SIZE];
        scalar K[SIZE];
        random_row(SIZE, 0.5, phi);
        (void)ud_update(&ud, phi, K);
    }
    double before[SIZE][SIZE];
    for (uint8_t i = 0; i < SIZE; i++) {
        for (uint8_t j = 0; j < SIZE; j++) {
            before[i][j] = product(i, j);
        }
    }
    TEST_ASSERT_TRUE(fabs(before[0][1]) > 1e-4); /* correlated indeed */
    const scalar variance_before = ud_variance(&ud, 0);
    ud.D[0] += SCALAR(0.25);
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0.25, real(ud_variance(&ud, 0) - variance_before));
    for (uint8_t i = 0; i < SIZE; i++) {
        for (uint8_t j = 0; j < SIZE; j++) {
            TEST_ASSERT_DOUBLE_WITHIN(1e-6, before[i][j] + (i == 0 && j == 0 ? 0.25 : 0), product(i, j));
        }
    }
}

static void test_D_turns_negative_on_rows_that_are_alike(void)
{
    /* GIVEN rows of any strength that hardly differ, which breaks the covariance form WHEN updated THEN D >=
     * 0 */
    static const double variance[] = {1, 1, 1, 1, 1, 1, 1, 1, 1};
    for (int n = 0; n < 3000; n++) {
        const double strength = pow(10, lcg_uniform(&noise, 0, 10));
        scalar direction[SIZE];
        start(SIZE, variance);
        random_row(SIZE, strength, direction);
        for (int k = 0; k < 30; k++) {
            scalar phi[SIZE];
            scalar K[SIZE];
            random_row(SIZE, strength * 1e-3, phi);
            for (uint8_t i = 0; i < SIZE; i++) {
                phi[i] += direction[i];
            }
            (void)ud_update(&ud, phi, K);
            expect_covariance();
        }
    }
}

static void test_long_run_loses_the_covariance(void)
{
    /* GIVEN an hour and more of updates, 250 a second, with the load's walk WHEN run THEN P is still one and
     * the load's variance has settled, not wound up nor died */
    static const double variance[] = {0.4, 1e-5, 1e-5, 1e-4, 1e-5, 1e-4, 1e-5, 1e-5, 1e-6};
    const scalar walk = SCALAR(1e-10);
    double first = 0;
    double last = 0;
    start(SIZE, variance);
    for (int n = 0; n < 1000000; n++) {
        scalar phi[SIZE];
        scalar K[SIZE];
        random_row(SIZE, 10, phi);
        ud.D[0] += walk;
        (void)ud_update(&ud, phi, K);
        expect_covariance();
        first = n == 20000 ? real(ud_variance(&ud, 0)) : first;
    }
    last = real(ud_variance(&ud, 0));
    TEST_ASSERT_TRUE(last > 0.1 * first);
    TEST_ASSERT_TRUE(last < 10 * first);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_one_parameter_by_hand);
    RUN_TEST(test_factors_drift_from_the_covariance_form);
    RUN_TEST(test_estimate_does_not_reach_the_truth);
    RUN_TEST(test_pinned_parameter_moves);
    RUN_TEST(test_walk_of_the_load_spreads_to_others);
    RUN_TEST(test_D_turns_negative_on_rows_that_are_alike);
    RUN_TEST(test_long_run_loses_the_covariance);
    return UNITY_END();
}
