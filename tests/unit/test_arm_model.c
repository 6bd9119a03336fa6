/* The arm's equations (control/arm_model) against mechanics: momentum, energy, gravity, signs. Torques, masses and
 * inertias are over 2^TORQUE_BASE, so that every number type holds them; the assertions are in SI. */
#include "control/arm_model.h"
#include "testing.h"

/* N m, of torques up to 100 N m; the rates are numeric, over STEP_S. */
#define TOLERANCE BY_TYPE(1e-9, 1e-4, 3e-6)
#define RATE_TOLERANCE BY_TYPE(1e-7, 2e-2, 1.5e-4)
#define STEP_S BY_TYPE(1e-3, 2e-2, 2e-2)

#define TORQUE_BASE 4
#define OVER_BASE(si) SCALAR((si) / 16.0)

static const struct arm ARM = {
    .L1 = SCALAR(0.8),
    .L2 = SCALAR(0.4),
    .I1 = OVER_BASE(3),
    .g = SCALAR(9.81),
    .coulomb_rate = SCALAR(1.0 / 900),
};

/* 5 kg at the tip of the reference arm. */
static const scalar THETA[THETA_M] = {
    [M_T] = OVER_BASE(5),  [J] = OVER_BASE(0.8 / 3), [M2] = OVER_BASE(5),
    [FV1] = OVER_BASE(12), [FV2] = OVER_BASE(4),     [FC1] = OVER_BASE(6),
    [FC2] = OVER_BASE(2),  [OM1] = OVER_BASE(3),     [OM2] = OVER_BASE(-0.7),
};

/* Where friction acts at the cylinder: the lever arm over that at q = 0. */
static const scalar LEVER = SCALAR(0.8);

void setUp(void)
{
}

void tearDown(void)
{
}

static double si(scalar x)
{
    return si_of(x, TORQUE_BASE);
}

/* What the smooth sign of friction must be, for the rate and the constant that the type can hold. */
static double smooth_sign(scalar w)
{
    return 2 / PI_REAL * atan(real(w) / real(ARM.coulomb_rate));
}

/* A smooth motion of both joints, nowhere at rest for long. */
static void motion(double t, scalar q[JOINTS], scalar w[JOINTS], scalar a[JOINTS])
{
    q[SWING] = from_real(0.4 * sin(1.3 * t));
    w[SWING] = from_real(0.4 * 1.3 * cos(1.3 * t));
    a[SWING] = from_real(-0.4 * 1.3 * 1.3 * sin(1.3 * t));
    q[WRIST] = from_real(0.2 + 0.7 * sin(1.9 * t + 0.5));
    w[WRIST] = from_real(0.7 * 1.9 * cos(1.9 * t + 0.5));
    a[WRIST] = from_real(-0.7 * 1.9 * 1.9 * sin(1.9 * t + 0.5));
}

/* theta without friction and offset. */
static void frictionless(scalar theta[THETA_M])
{
    for (uint8_t k = 0; k < THETA_M; k++) {
        theta[k] = k <= M2 ? THETA[k] : SCALAR(0);
    }
}

static scalar torque(const struct arm *arm, scalar q2, enum joint i, const scalar w[JOINTS],
                     const scalar a[JOINTS], const scalar theta[THETA_M])
{
    const struct wrist_trig t = wrist_trig(arm, q2);
    struct arm_row row;
    arm_inverse_dynamics(arm, &t, i, w, a, coulomb_sign(arm, w[i]), SCALAR(1), &row);
    return arm_row_torque(&row, i, theta);
}

static void momentum_at(double time, enum joint i, struct arm_row *row)
{
    scalar q[JOINTS];
    scalar w[JOINTS];
    scalar a[JOINTS];
    motion(time, q, w, a);
    const struct wrist_trig t = wrist_trig(&ARM, q[WRIST]);
    arm_momentum(&ARM, &t, i, w, row);
}

/* Slope of four samples at -2, -1, 1, 2 steps; exact to the fourth order. */
static double slope(const double y[4], double step)
{
    return (8 * (y[2] - y[1]) - (y[3] - y[0])) / (12 * step);
}

static void test_momentum_form_is_another_model_than_the_inverse_dynamics(void)
{
    /* GIVEN a smooth motion WHEN the momentum's rate and arm_force are added THEN column by column they are
     * the inverse dynamics: the estimator and the law see one arm */
    static const int at[4] = {-2, -1, 1, 2};
    for (double time = 0; time < 6; time += 0.037) {
        scalar q[JOINTS];
        scalar w[JOINTS];
        scalar a[JOINTS];
        motion(time, q, w, a);
        const struct wrist_trig t = wrist_trig(&ARM, q[WRIST]);
        for (uint8_t i = 0; i < JOINTS; i++) {
            struct arm_row momentum[4];
            struct arm_row force;
            struct arm_row whole;
            for (uint8_t n = 0; n < 4; n++) {
                momentum_at(time + at[n] * STEP_S, (enum joint)i, &momentum[n]);
            }
            arm_force(&ARM, &t, (enum joint)i, w, coulomb_sign(&ARM, w[i]), LEVER, &force);
            arm_inverse_dynamics(&ARM, &t, (enum joint)i, w, a, coulomb_sign(&ARM, w[i]), LEVER, &whole);
            for (uint8_t k = 0; k <= ROW_COLUMNS; k++) {
                double y[4];
                for (uint8_t n = 0; n < 4; n++) {
                    y[n] = k < ROW_COLUMNS ? real(momentum[n].phi[k]) : si(momentum[n].known);
                }
                const double f = k < ROW_COLUMNS ? real(force.phi[k]) : si(force.known);
                const double expected = k < ROW_COLUMNS ? real(whole.phi[k]) : si(whole.known);
                TEST_ASSERT_DOUBLE_WITHIN(RATE_TOLERANCE, expected, slope(y, STEP_S) + f);
            }
        }
    }
}

static void test_inertia_is_not_that_of_the_momentum(void)
{
    /* GIVEN any angle WHEN a joint turns THEN its momentum is H_ii times its rate, whatever the other does */
    for (double q2 = -1; q2 <= 1.2; q2 += 0.1) {
        const struct wrist_trig t = wrist_trig(&ARM, from_real(q2));
        const scalar w[JOINTS] = {SCALAR(0.7), SCALAR(-1.1)};
        for (uint8_t i = 0; i < JOINTS; i++) {
            struct arm_row row;
            arm_momentum(&ARM, &t, (enum joint)i, w, &row);
            const double H = si(arm_inertia(&ARM, &t, (enum joint)i, THETA));
            TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE, H * real(w[i]),
                                      si(arm_row_torque(&row, (enum joint)i, THETA)));
        }
    }
}

static void test_inertia_of_the_reference_arm_wrong(void)
{
    /* GIVEN 5 kg WHEN the wrist is level, or straight up THEN the inertias worked out by hand, Eq 2 */
    const struct wrist_trig level = wrist_trig(&ARM, SCALAR(0));
    const struct wrist_trig up = wrist_trig(&ARM, SCALAR(PI_REAL / 2));
    /* 3 + 5 0.8 1.2 + 0.2667 + 5 1.44 and 3 + 5 0.64 + 0 + 5 0.64 */
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 15.2666667, si(arm_inertia(&ARM, &level, SWING, THETA)));
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 9.4, si(arm_inertia(&ARM, &up, SWING, THETA)));
    /* 0.2667 + 5 0.16 */
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 1.0666667, si(arm_inertia(&ARM, &level, WRIST, THETA)));
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 1.0666667, si(arm_inertia(&ARM, &up, WRIST, THETA)));
}

/* C(q, q') q': what is left of the inverse dynamics without acceleration, friction, offset and gravity. */
static void coriolis(scalar q2, const scalar w[JOINTS], double C_w[JOINTS])
{
    struct arm weightless = ARM;
    weightless.g = SCALAR(0);
    scalar theta[THETA_M];
    frictionless(theta);
    static const scalar none[JOINTS] = {SCALAR(0), SCALAR(0)};
    for (uint8_t i = 0; i < JOINTS; i++) {
        C_w[i] = si(torque(&weightless, q2, (enum joint)i, w, none, theta));
    }
}

static void test_coriolis_terms_make_energy(void)
{
    /* GIVEN any angle, rates w and any x WHEN C(q, w) x is taken from C(q, w) w by polarisation THEN
     * x'(H' - 2C)x = 0, Eq 3: the skew symmetry that the stability proof needs */
    struct lcg noise = {7};
    for (int n = 0; n < 300; n++) {
        const double q2 = lcg_uniform(&noise, -1, 1.2);
        scalar w[JOINTS];
        scalar x[JOINTS];
        scalar sum[JOINTS];
        double C_w[JOINTS];
        double C_x[JOINTS];
        double C_sum[JOINTS];
        for (uint8_t i = 0; i < JOINTS; i++) {
            w[i] = from_real(lcg_uniform(&noise, -2, 2));
            x[i] = from_real(lcg_uniform(&noise, -2, 2));
            sum[i] = w[i] + x[i];
        }
        coriolis(from_real(q2), w, C_w);
        coriolis(from_real(q2), x, C_x);
        coriolis(from_real(q2), sum, C_sum);
        double H[4];
        static const int at[4] = {-2, -1, 1, 2};
        for (uint8_t k = 0; k < 4; k++) {
            const struct wrist_trig t = wrist_trig(&ARM, from_real(q2 + at[k] * STEP_S));
            H[k] = si(arm_inertia(&ARM, &t, SWING, THETA));
        }
        /* H22 is constant */
        const double x_H_rate_x = slope(H, STEP_S) * real(w[WRIST]) * real(x[SWING]) * real(x[SWING]);
        double x_C_x = 0;
        for (uint8_t i = 0; i < JOINTS; i++) {
            x_C_x += real(x[i]) * (C_sum[i] - C_w[i] - C_x[i]) / 2;
        }
        TEST_ASSERT_DOUBLE_WITHIN(10 * RATE_TOLERANCE, x_H_rate_x, 2 * x_C_x);
    }
}

static void test_gravity_pulls_the_wrong_way(void)
{
    /* GIVEN the arm at rest WHEN the wrist is level THEN holding it takes g L2 (m2/2 + m_t) upwards, none
     * when it points straight up, and the swing never feels weight */
    static const scalar still[JOINTS] = {SCALAR(0), SCALAR(0)};
    scalar theta[THETA_M];
    frictionless(theta);
    TEST_ASSERT_DOUBLE_WITHIN(1e-4, 29.43, si(torque(&ARM, SCALAR(0), WRIST, still, still, theta)));
    TEST_ASSERT_DOUBLE_WITHIN(1e-4, 29.43 * 0.5,
                              si(torque(&ARM, SCALAR(PI_REAL / 3), WRIST, still, still, theta)));
    TEST_ASSERT_DOUBLE_WITHIN(1e-4, 0, si(torque(&ARM, SCALAR(PI_REAL / 2), WRIST, still, still, theta)));
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0, si(torque(&ARM, SCALAR(0.3), SWING, still, still, theta)));
}

static void test_centrifugal_force_lifts_the_load(void)
{
    /* GIVEN the swing turning WHEN the wrist points up THEN the load is thrown outwards, that is down: it
     * takes more torque to hold, and by hand L2 s w1^2 (m_t r + m2 L1 / 2) + J c s w1^2 */
    static const scalar still[JOINTS] = {SCALAR(0), SCALAR(0)};
    static const scalar turning[JOINTS] = {SCALAR(2), SCALAR(0)};
    scalar theta[THETA_M];
    frictionless(theta);
    const double s = sin(0.5);
    const double c = cos(0.5);
    const double by_hand = 4 * (0.4 * s * (5 * (0.8 + 0.4 * c) + 5 * 0.8 / 2) + 0.8 / 3 * c * s);
    const double held = si(torque(&ARM, SCALAR(0.5), WRIST, still, still, theta));
    const double spun = si(torque(&ARM, SCALAR(0.5), WRIST, turning, still, theta));
    TEST_ASSERT_DOUBLE_WITHIN(1e-4, by_hand, spun - held);
    TEST_ASSERT_TRUE(by_hand > 1);
}

static double energy_at(double time)
{
    scalar q[JOINTS];
    scalar w[JOINTS];
    scalar a[JOINTS];
    motion(time, q, w, a);
    const struct wrist_trig t = wrist_trig(&ARM, q[WRIST]);
    double energy = 9.81 * 0.4 * real(t.s) * (2.5 + 5);
    for (uint8_t i = 0; i < JOINTS; i++) {
        energy += 0.5 * si(arm_inertia(&ARM, &t, (enum joint)i, THETA)) * real(w[i]) * real(w[i]);
    }
    return energy;
}

static void test_energy_appears_or_vanishes(void)
{
    /* GIVEN a smooth motion without friction WHEN the torques do work THEN kinetic and potential energy grow
     * by exactly that */
    scalar theta[THETA_M];
    frictionless(theta);
    for (double time = 0; time < 6; time += 0.043) {
        scalar q[JOINTS];
        scalar w[JOINTS];
        scalar a[JOINTS];
        motion(time, q, w, a);
        double power = 0;
        for (uint8_t i = 0; i < JOINTS; i++) {
            power += real(w[i]) * si(torque(&ARM, q[WRIST], (enum joint)i, w, a, theta));
        }
        const double E[4] = {energy_at(time - 2 * STEP_S), energy_at(time - STEP_S), energy_at(time + STEP_S),
                             energy_at(time + 2 * STEP_S)};
        TEST_ASSERT_DOUBLE_WITHIN(10 * RATE_TOLERANCE, power, slope(E, STEP_S));
    }
}

static void test_friction_drives_instead_of_braking(void)
{
    /* GIVEN a joint that moves WHEN friction is all there is THEN it costs torque in the direction of motion,
     * viscous and Coulomb of that joint alone */
    struct arm weightless = ARM;
    weightless.g = SCALAR(0);
    static const scalar none[JOINTS] = {SCALAR(0), SCALAR(0)};
    scalar theta[THETA_M] = {SCALAR(0)};
    theta[FV1] = OVER_BASE(12);
    theta[FC1] = OVER_BASE(6);
    theta[FV2] = OVER_BASE(4);
    theta[FC2] = OVER_BASE(2);
    weightless.I1 = SCALAR(0);
    const scalar w[JOINTS] = {SCALAR(0.5), SCALAR(-0.5)};
    const double s = smooth_sign(w[SWING]);
    TEST_ASSERT_DOUBLE_WITHIN(1e-4, 6 + 6 * s, si(torque(&weightless, SCALAR(0.2), SWING, w, none, theta)));
    TEST_ASSERT_DOUBLE_WITHIN(1e-4, -2 - 2 * s, si(torque(&weightless, SCALAR(0.2), WRIST, w, none, theta)));
}

static void test_friction_sign_taken_of_the_noisy_rate(void)
{
    /* GIVEN a measured rate that noise turned round WHEN the row is made THEN Coulomb friction has the sign
     * of the rate it is given for that, and viscous friction that of the measured one */
    const struct wrist_trig t = wrist_trig(&ARM, SCALAR(0.2));
    const scalar w[JOINTS] = {SCALAR(-0.01), SCALAR(0.02)};
    struct arm_row row;
    arm_force(&ARM, &t, SWING, w, coulomb_sign(&ARM, SCALAR(0.3)), SCALAR(1), &row);
    TEST_ASSERT_TRUE(row.phi[COL_FV] == w[SWING]);
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, smooth_sign(SCALAR(0.3)), real(row.phi[COL_FC]));
}

static void test_friction_of_the_cylinder_acts_at_the_joint(void)
{
    /* GIVEN friction at the cylinder WHEN its lever arm is 0.8 of that at q = 0 THEN Coulomb friction is 0.8
     * of what it is there, viscous friction 0.64, and no other term changes */
    const struct wrist_trig t = wrist_trig(&ARM, SCALAR(0.2));
    const scalar w[JOINTS] = {SCALAR(0.4), SCALAR(0.3)};
    const scalar a[JOINTS] = {SCALAR(1), SCALAR(2)};
    for (uint8_t i = 0; i < JOINTS; i++) {
        struct arm_row joint[2];
        struct arm_row cylinder[2];
        arm_inverse_dynamics(&ARM, &t, (enum joint)i, w, a, coulomb_sign(&ARM, w[i]), SCALAR(1), &joint[0]);
        arm_inverse_dynamics(&ARM, &t, (enum joint)i, w, a, coulomb_sign(&ARM, w[i]), LEVER, &cylinder[0]);
        arm_force(&ARM, &t, (enum joint)i, w, coulomb_sign(&ARM, w[i]), SCALAR(1), &joint[1]);
        arm_force(&ARM, &t, (enum joint)i, w, coulomb_sign(&ARM, w[i]), LEVER, &cylinder[1]);
        for (uint8_t n = 0; n < 2u; n++) {
            for (uint8_t k = 0; k < ROW_COLUMNS; k++) {
                const double factor = k == COL_FV ? 0.64 : k == COL_FC ? 0.8 : 1;
                TEST_ASSERT_DOUBLE_WITHIN(1e-6, factor * real(joint[n].phi[k]), real(cylinder[n].phi[k]));
            }
            TEST_ASSERT_TRUE(joint[n].known == cylinder[n].known);
        }
    }
}

static void test_smooth_sign_not_a_sign(void)
{
    /* GIVEN rates of all sizes WHEN the sign is taken THEN odd, growing, within -1..1, a half at 1/900 rad/s
     * */
    scalar before = SCALAR(-1);
    for (double w = -3; w <= 3; w += 1e-3) {
        const scalar s = coulomb_sign(&ARM, from_real(w));
        TEST_ASSERT_TRUE(s >= before);
        TEST_ASSERT_TRUE(absolute(s) < SCALAR(1));
        TEST_ASSERT_TRUE(coulomb_sign(&ARM, from_real(-w)) == -s);
        TEST_ASSERT_DOUBLE_WITHIN(1e-6, smooth_sign(from_real(w)), real(s));
        before = s;
    }
    TEST_ASSERT_TRUE(coulomb_sign(&ARM, SCALAR(0)) == SCALAR(0));
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0.5, real(coulomb_sign(&ARM, SCALAR(1.0 / 900))));
}

static void test_torque_offset_counted_with_the_wrong_sign(void)
{
    /* GIVEN an offset that helps WHEN torques are worked out THEN R F need be smaller by just that; each
     * joint has its own */
    static const scalar still[JOINTS] = {SCALAR(0), SCALAR(0)};
    scalar theta[THETA_M] = {SCALAR(0)};
    theta[OM1] = OVER_BASE(3);
    theta[OM2] = OVER_BASE(-0.7);
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, -3, si(torque(&ARM, SCALAR(0.2), SWING, still, still, theta)));
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0.7, si(torque(&ARM, SCALAR(0.2), WRIST, still, still, theta)));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_momentum_form_is_another_model_than_the_inverse_dynamics);
    RUN_TEST(test_inertia_is_not_that_of_the_momentum);
    RUN_TEST(test_inertia_of_the_reference_arm_wrong);
    RUN_TEST(test_coriolis_terms_make_energy);
    RUN_TEST(test_gravity_pulls_the_wrong_way);
    RUN_TEST(test_centrifugal_force_lifts_the_load);
    RUN_TEST(test_energy_appears_or_vanishes);
    RUN_TEST(test_friction_drives_instead_of_braking);
    RUN_TEST(test_friction_sign_taken_of_the_noisy_rate);
    RUN_TEST(test_friction_of_the_cylinder_acts_at_the_joint);
    RUN_TEST(test_smooth_sign_not_a_sign);
    RUN_TEST(test_torque_offset_counted_with_the_wrong_sign);
    return UNITY_END();
}
