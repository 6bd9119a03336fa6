/* The UD factors (control/ud_factors) against the covariance form of the same least squares, in double. */
#include "control/ud_factors.h"
#include "testing.h"

/* Of gains of order one, and of variances over the noise's, over some hundred updates. */
#define TOLERANCE BY_TYPE(1e-10, 2e-4, 1.5e-5)
/* The same of one update. */
#define ONE_UPDATE BY_TYPE(1e-15, 1e-6, 3e-6)
/* Decades that a prior may be above the noise; fixed point's K = sqrt(D / noise) / 2 ends at 2048. */
#define DECADES BY_TYPE(10, 10, 3.6)

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

static void start(uint8_t size, const double prior[])
{
    variance v[SIZE] = {0};
    memset(P, 0, sizeof P);
    for (uint8_t k = 0; k < size; k++) {
        v[k] = variance_from_real(prior[k]);
        P[k][k] = real_variance(v[k]);
    }
    ud_start(&ud, size, v);
}

static void random_row(uint8_t size, double amplitude, scalar phi[SIZE])
{
    for (uint8_t k = 0; k < size; k++) {
        phi[k] = from_real(lcg_uniform(&noise, -amplitude, amplitude));
    }
}

/* P - K phi'P, K = P phi / (noise + phi'P phi) */
static double covariance_update(uint8_t size, const scalar phi[SIZE], variance noise_variance, double K[SIZE])
{
    double P_phi[SIZE] = {0};
    double alpha = real_variance(noise_variance);
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
        sum += Uik * real_variance(ud.D[k]) * Ujk;
    }
    return sum;
}

static void expect_covariance(double most)
{
    for (uint8_t k = 0; k < ud.size; k++) {
        TEST_ASSERT_TRUE(real_variance(ud.D[k]) >= 0); /* false for NaN too */
        TEST_ASSERT_TRUE(real_variance(ud.D[k]) <= most);
    }
}

static void test_one_parameter_by_hand(void)
{
    /* GIVEN variance 0.4 WHEN measured once with phi = 1 and a noise of 0.1 THEN innovation 0.5, gain 0.8,
     * variance 0.08 */
    const double prior[] = {0.4};
    const scalar phi[SIZE] = {SCALAR(1)};
    gain K[SIZE];
    start(1, prior);
    TEST_ASSERT_DOUBLE_WITHIN(ONE_UPDATE, 0.5, real_variance(ud_update(&ud, phi, VARIANCE(0.1), K)));
    TEST_ASSERT_DOUBLE_WITHIN(ONE_UPDATE, 0.8, real_gain(K[0]));
    TEST_ASSERT_DOUBLE_WITHIN(ONE_UPDATE, 0.08, real_variance(ud_variance(&ud, 0)));
}

static void test_factors_drift_from_the_covariance_form(void)
{
    /* GIVEN random rows and every size WHEN updated THEN gain, innovation and P are the covariance form's */
    const double unit = 1.0 / 16;
    const variance of_noise = VARIANCE(1.0 / 16);
    for (uint8_t size = 1; size <= SIZE; size++) {
        double prior[SIZE];
        for (uint8_t k = 0; k < size; k++) {
            prior[k] = unit * lcg_uniform(&noise, 0.1, 2);
        }
        start(size, prior);
        for (int n = 0; n < 200; n++) {
            scalar phi[SIZE] = {0};
            gain K[SIZE];
            double expected_K[SIZE];
            random_row(size, 1, phi);
            const double alpha = covariance_update(size, phi, of_noise, expected_K);
            TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE * alpha, alpha,
                                      real_variance(ud_update(&ud, phi, of_noise, K)));
            for (uint8_t i = 0; i < size; i++) {
                TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, expected_K[i], real_gain(K[i]));
                TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE * unit, P[i][i], real_variance(ud_variance(&ud, i)));
                for (uint8_t j = 0; j < size; j++) {
                    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE * unit, P[i][j], product(i, j));
                }
            }
        }
    }
}

static void test_estimate_does_not_reach_the_truth(void)
{
    /* GIVEN exact measurements WHEN theta += K (y - phi' theta) THEN theta is found, with little variance */
    static const double truth[] = {0.4, -0.2, 0.7, 0.1, -0.6, 0.3, 0.05, -0.9, 0.5};
    static const double prior[] = {0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2};
    double theta[SIZE] = {0};
    start(SIZE, prior);
    for (int n = 0; n < 5000; n++) {
        scalar phi[SIZE];
        gain K[SIZE];
        random_row(SIZE, 0.9, phi);
        double residual = 0;
        for (uint8_t k = 0; k < SIZE; k++) {
            residual += real(phi[k]) * (truth[k] - theta[k]);
        }
        (void)ud_update(&ud, phi, VARIANCE(0.02), K);
        for (uint8_t k = 0; k < SIZE; k++) {
            theta[k] += real_gain(K[k]) * residual;
        }
    }
    for (uint8_t k = 0; k < SIZE; k++) {
        TEST_ASSERT_DOUBLE_WITHIN(1e-3, truth[k], theta[k]);
        TEST_ASSERT_DOUBLE_WITHIN(2e-5, 0, real_variance(ud_variance(&ud, k)));
    }
}

static void test_pinned_parameter_moves(void)
{
    /* GIVEN one parameter of zero variance, whichever WHEN others learn THEN its gain and variance are 0 */
    for (uint8_t pinned = 0; pinned < SIZE; pinned++) {
        double prior[SIZE];
        for (uint8_t k = 0; k < SIZE; k++) {
            prior[k] = k == pinned ? 0 : 0.2;
        }
        start(SIZE, prior);
        for (int n = 0; n < 300; n++) {
            scalar phi[SIZE];
            gain K[SIZE];
            random_row(SIZE, 0.9, phi);
            (void)ud_update(&ud, phi, VARIANCE(0.006), K);
            TEST_ASSERT_TRUE(K[pinned] == GAIN(0));
            TEST_ASSERT_TRUE(ud_variance(&ud, pinned) == VARIANCE(0));
        }
    }
}

static void test_walk_of_the_load_spreads_to_others(void)
{
    /* GIVEN correlated parameters WHEN D[0] grows THEN P(0,0) grows by as much and nothing else moves */
    static const double prior[] = {0.125, 0.0625, 0.25, 0.125, 0.0375, 0.125, 0.1875, 0.125, 0.0875};
    start(SIZE, prior);
    for (int n = 0; n < 50; n++) {
        scalar phi[SIZE];
        gain K[SIZE];
        random_row(SIZE, 0.5, phi);
        (void)ud_update(&ud, phi, VARIANCE(0.125), K);
    }
    double before[SIZE][SIZE];
    for (uint8_t i = 0; i < SIZE; i++) {
        for (uint8_t j = 0; j < SIZE; j++) {
            before[i][j] = product(i, j);
        }
    }
    TEST_ASSERT_TRUE(fabs(before[0][1]) > 1e-5); /* correlated indeed */
    const variance variance_before = ud_variance(&ud, 0);
    const double walk = 0x1p-5;
    ud.D[0] += VARIANCE(0x1p-5);
    TEST_ASSERT_DOUBLE_WITHIN(1e-7, walk, real_variance(ud_variance(&ud, 0) - variance_before));
    for (uint8_t i = 0; i < SIZE; i++) {
        for (uint8_t j = 0; j < SIZE; j++) {
            TEST_ASSERT_DOUBLE_WITHIN(1e-7, before[i][j] + (i == 0 && j == 0 ? walk : 0), product(i, j));
        }
    }
}

static void test_D_turns_negative_on_rows_that_are_alike(void)
{
    /* GIVEN rows of any strength over the noise that hardly differ, which breaks the covariance form WHEN
     * updated THEN 0 <= D <= its prior */
    static const double prior[] = {0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2};
    for (int n = 0; n < 3000; n++) {
        const double strength = pow(10, lcg_uniform(&noise, 0, DECADES));
        const variance of_noise = variance_from_real(0.2 / (strength * strength));
        scalar direction[SIZE];
        start(SIZE, prior);
        random_row(SIZE, 0.9, direction);
        for (int k = 0; k < 30; k++) {
            scalar phi[SIZE];
            gain K[SIZE];
            random_row(SIZE, 0.9e-3, phi);
            for (uint8_t i = 0; i < SIZE; i++) {
                phi[i] += direction[i];
            }
            (void)ud_update(&ud, phi, of_noise, K);
            expect_covariance(0.2 * (1 + 1e-5));
        }
    }
}

static void test_long_run_loses_the_covariance(void)
{
    /* GIVEN an hour and more of updates, 250 a second, with the load's walk as the estimator adds it, every 50
     * updates WHEN run THEN P is still one and the load's variance has settled, not wound up nor died */
    static const double prior[] = {0.4, 1e-5, 1e-5, 1e-4, 1e-5, 1e-4, 1e-5, 1e-5, 1e-6};
    double first = 0;
    double last = 0;
    start(SIZE, prior);
    for (int n = 0; n < 1000000; n++) {
        scalar phi[SIZE];
        gain K[SIZE];
        random_row(SIZE, 0.5, phi);
        if (n % 50 == 0) {
            ud.D[0] += VARIANCE(50 * 1e-10);
        }
        (void)ud_update(&ud, phi, VARIANCE(0.0025), K);
        expect_covariance(0.4 + 1e-5);
        first = n == 20000 ? real_variance(ud_variance(&ud, 0)) : first;
    }
    last = real_variance(ud_variance(&ud, 0));
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
