/* The two steps of DIARC (control/diarc) for the reference arm's wrist, stated in SI, worked out over the reference
 * arm's bases. The law is tuned elsewhere; here are its signs, its bounds and how it starts. */
#include "control/diarc.h"
#include "testing.h"

/* Of a spool; of forces in N. */
#define TOLERANCE_U BY_TYPE(1e-12, 1e-5, 3e-6)
#define TOLERANCE_N BY_TYPE(1e-9, 5e-3, 1e-4)

/* Far more uncertainty than there can be, per unit: the most that a sum may be formed with. */
#define ABSURD BY_TYPE(1e13, 1e13, 31)

/* Binary logarithms of the bases: pressure 2^22, area 2^-12, lever arm 2^-3. */
enum {
    PRESSURE = 22,
    FLOW = -12, /* QL */
    LEVER = -3,
    FORCE = PRESSURE + FLOW,
    TORQUE = FORCE + LEVER,
    COMPLIANCE = -PRESSURE,
    ETA2 = FORCE + FLOW,
    WEIGHT = FLOW - LEVER /* w1 / w2; lamA as well */
};

static const double DT_S = 1e-3;
static const gain PER_TICK = GAIN(1000);

static struct diarc diarc;
static struct diarc_gains gains;
static struct diarc_input in;

/* 3 kg held still at 0.3 rad: 700 N in the cylinder, and leakage that an offset of the valve makes up for. */
void setUp(void)
{
    diarc = (struct diarc){0};
    gains = (struct diarc_gains){
        .k1 = GAIN(60),
        .k2 = GAIN(80),
        .k3 = GAIN(250),
        .kappa1 = GAIN(1000),
        .kappa2 = GAIN(200),
        .w1_over_w2 = per_unit(1e-5, WEIGHT),
        .eta1 = per_unit(100, TORQUE),
        .eta2 = per_unit(1, ETA2),
        .k2s1_max = GAIN(10),
        .k2s2_max = GAIN(25),
        .gamma1_max = per_unit(90, TORQUE),
        .gamma2_max = per_unit(2e-4, FLOW),
    };
    in = (struct diarc_input){
        .torque_ff = per_unit(21, TORQUE),
        .torque_uncertainty = per_unit(5, TORQUE),
        .H = per_unit(0.75, TORQUE),
        .beta_inverse = per_unit(1e-9, COMPLIANCE),
        .beta_share = from_real(0.1),
        .flow_offset = per_unit(2e-6, FLOW),
        .flow_uncertainty = per_unit(4e-6, FLOW),
        .cylinder = {.R = per_unit(0.055, LEVER),
                     .lamB = per_unit(8, -LEVER),
                     .lamC = per_unit(6, -LEVER),
                     .lamA = per_unit(6e-3, WEIGHT)},
        .force = per_unit(700, FORCE),
        .leakage = per_unit(2e-6, FLOW),
    };
}

void tearDown(void)
{
}

static void start(void)
{
    diarc_start(&diarc, &gains, &in);
}

/* One tick; the valve passes more oil one way. */
static struct diarc_output tick(struct diarc *d, const struct diarc_input *input)
{
    const struct diarc_constants constants = diarc_constants(&gains);
    const struct diarc_steps steps = diarc_flow(d, &gains, &constants, input, PER_TICK);
    const scalar QL_gain = per_unit(steps.Q_Ld >= SCALAR(0) ? 1.2e-3 : 0.9e-3, FLOW);
    return diarc_opening(d, &gains, input, &steps, QL_gain, from_real(DT_S));
}

/* One tick from the same state, without moving on. */
static struct diarc_output try_out(const struct diarc_input *input)
{
    struct diarc copy = diarc;
    return tick(&copy, input);
}

static struct diarc_output step(void)
{
    return tick(&diarc, &in);
}

/* Spool set-point with the pure feedback of the gains that are left on. */
static double spool_of(const struct diarc_input *input)
{
    const struct diarc_output out = try_out(input);
    TEST_ASSERT_FALSE(out.saturated);
    return real(out.u);
}

static void test_arm_jumps_when_armed(void)
{
    /* GIVEN an arm that rests on its reference, held by a force the model does not expect WHEN armed THEN
     * that force is the one wanted and the valve stays shut */
    start();
    const struct diarc_output out = step();
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_N, 700, si_of(out.F_Ld, FORCE));
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_N, 0, si_of(out.e3, FORCE));
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_U, 0, real(out.u));
    TEST_ASSERT_DOUBLE_WITHIN(1e-4, 21 - 0.055 * 700, si_of(diarc.gamma1, TORQUE));
}

static void test_arm_creeps_after_it_was_armed(void)
{
    /* GIVEN an arm armed at rest WHEN nothing changes for 1 s THEN neither does the valve */
    start();
    for (int k = 0; k < 1000; k++) {
        TEST_ASSERT_DOUBLE_WITHIN(10 * TOLERANCE_U, 0, real(step().u));
    }
}

static void test_start_beyond_the_bounds_of_gamma(void)
{
    /* GIVEN a force far from what the model expects WHEN armed THEN gamma starts at its bound, not beyond */
    in.force = per_unit(9000, FORCE);
    start();
    TEST_ASSERT_TRUE(diarc.gamma1 == -gains.gamma1_max);
    setUp();
    in.force = per_unit(-9000, FORCE);
    start();
    TEST_ASSERT_TRUE(diarc.gamma1 == gains.gamma1_max);
}

static void test_adaptation_kicks_the_arm(void)
{
    /* GIVEN the law at work WHEN the estimate steps by 5 N m between two ticks THEN force and valve do not */
    start();
    (void)step();
    const struct diarc_output without = try_out(&in);
    struct diarc_input adapted = in;
    adapted.torque_ff += per_unit(5, TORQUE);
    adapted.torque_step = per_unit(5, TORQUE);
    const struct diarc_output with = try_out(&adapted);
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_N, si_of(without.F_Ld, FORCE), si_of(with.F_Ld, FORCE));
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_U, real(without.u), real(with.u));
    /* and the same step of the reference's torque does move both */
    adapted.torque_step = SCALAR(0);
    const struct diarc_output moved = try_out(&adapted);
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_N, si_of(without.F_Ld, FORCE) + 5 / 0.055, si_of(moved.F_Ld, FORCE));
    TEST_ASSERT_TRUE(moved.u > without.u);
}

static void test_error_driven_further(void)
{
    /* GIVEN an arm ahead of its reference, or running away WHEN controlled THEN less force is wanted and the
     * valve draws back; behind it, the other way round; e2 = e1' + k1 e1 */
    start();
    for (int sign = -1; sign <= 1; sign += 2) {
        struct diarc_input off = in;
        off.e1 = from_real(sign * 1e-4);
        struct diarc_output out = try_out(&off);
        TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_U, sign * 6e-3, real(out.e2));
        TEST_ASSERT_TRUE(sign * (si_of(out.F_Ld, FORCE) - 700) < 0);
        TEST_ASSERT_TRUE(sign * real(out.u) < 0);
        off.e1 = SCALAR(0);
        off.e1_rate = from_real(sign * 1e-3);
        out = try_out(&off);
        TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_U, sign * 1e-3, real(out.e2));
        TEST_ASSERT_TRUE(sign * (si_of(out.F_Ld, FORCE) - 700) < 0);
    }
}

static void test_error_driven_further_on_a_crank_the_other_way_round(void)
{
    /* GIVEN a crank whose extension turns the joint back WHEN the arm is ahead THEN more force is wanted */
    in.cylinder.R = per_unit(-0.055, LEVER);
    in.force = per_unit(-400, FORCE);
    start();
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_U, 0, real(try_out(&in).u));
    in.e1 = SCALAR(1e-4);
    const struct diarc_output out = try_out(&in);
    TEST_ASSERT_TRUE(si_of(out.F_Ld, FORCE) > -400);
    TEST_ASSERT_TRUE(real(out.u) > 0);
}

static void test_too_much_force_driven_further(void)
{
    /* GIVEN more force than wanted WHEN controlled THEN e3 is positive and the valve lets force off */
    start();
    in.force += per_unit(20, FORCE);
    const struct diarc_output out = try_out(&in);
    TEST_ASSERT_DOUBLE_WITHIN(TOLERANCE_N, 20, si_of(out.e3, FORCE));
    TEST_ASSERT_TRUE(real(out.u) < 0);
}

/* The law without its feedback, at rest. */
static void no_feedback(void)
{
    gains.k1 = gains.k2 = gains.k3 = GAIN(0);
    gains.kappa1 = gains.kappa2 = GAIN(0);
    gains.k2s1_max = gains.k2s2_max = GAIN(0);
    gains.w1_over_w2 = SCALAR(0);
    gains.gamma2_max = SCALAR(0);
    start();
}

static void test_feed_forward_of_the_flow_has_the_wrong_sign(void)
{
    /* GIVEN no feedback WHEN the reference moves, oil leaks or the estimate knows an offset THEN the valve
     * opens for the displaced oil and for leakage, and closes by the offset, each as much as Eq 18 says */
    in.leakage = in.flow_offset = SCALAR(0);
    no_feedback();
    struct diarc_input other = in;
    other.reference_w = SCALAR(0.5);
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 6e-3 * 0.055 * 0.5 / 1.2e-3, spool_of(&other));
    other.reference_w = SCALAR(-0.5);
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, -6e-3 * 0.055 * 0.5 / 0.9e-3, spool_of(&other));
    other = in;
    other.leakage = per_unit(3e-5, FLOW);
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 3e-5 / 1.2e-3, spool_of(&other));
    other = in;
    other.flow_offset = per_unit(3e-5, FLOW);
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, -3e-5 / 0.9e-3, spool_of(&other));
}

static void test_rising_torque_not_fed_forward(void)
{
    /* GIVEN no feedback WHEN the feed-forward torque rises by 0.2 N m in a tick THEN oil to compress for it
     * */
    in.leakage = in.flow_offset = SCALAR(0);
    no_feedback();
    in.torque_ff += per_unit(0.2, TORQUE);
    TEST_ASSERT_DOUBLE_WITHIN(1e-4, 1e-9 * (0.2 / 1e-3 / 0.055) / 1.2e-3, spool_of(&in));
}

static void test_coupling_term_has_the_wrong_sign(void)
{
    /* GIVEN only mu, the arm itself at rest WHEN e2 is positive THEN -(w1/w2) R e2, Eq 18 */
    in.leakage = in.flow_offset = SCALAR(0);
    no_feedback();
    gains.w1_over_w2 = per_unit(1e-3, WEIGHT);
    in.e1_rate = SCALAR(0.1);
    in.reference_w = SCALAR(-0.1);
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, -1e-3 * 0.055 * 0.1 / 0.9e-3, spool_of(&in));
}

static void test_valve_gain_of_the_other_direction(void)
{
    /* GIVEN ports that pass more oil one way WHEN flow of either sign is wanted THEN its own gain divides */
    in.leakage = in.flow_offset = SCALAR(0);
    no_feedback();
    in.leakage = per_unit(9e-4, FLOW);
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, 0.75, spool_of(&in));
    in.leakage = per_unit(-4.5e-4, FLOW);
    TEST_ASSERT_DOUBLE_WITHIN(1e-5, -0.5, spool_of(&in));
}

static void test_fast_compensation_drives_the_error_up(void)
{
    /* GIVEN a small lasting error of either sign WHEN time goes on THEN gamma1 and the wanted force work
     * against e2, gamma2 and the valve against e3 */
    for (int sign = -1; sign <= 1; sign += 2) {
        setUp();
        start();
        const double gamma1 = si_of(diarc.gamma1, TORQUE);
        in.e1 = from_real(sign * 1e-6);
        const double before = si_of(step().F_Ld, FORCE);
        const double after = si_of(step().F_Ld, FORCE);
        TEST_ASSERT_TRUE(sign * (si_of(diarc.gamma1, TORQUE) - gamma1) > 0);
        TEST_ASSERT_TRUE(sign * (after - before) < 0);

        setUp();
        start();
        const double gamma2 = si_of(diarc.gamma2, FLOW);
        in.force += per_unit(sign * 1.0, FORCE);
        const double u_before = real(step().u);
        const double u_after = real(step().u);
        TEST_ASSERT_TRUE(sign * (si_of(diarc.gamma2, FLOW) - gamma2) > 0);
        TEST_ASSERT_TRUE(sign * (u_after - u_before) < 0);
    }
}

static void test_fast_compensation_beyond_its_bound(void)
{
    /* GIVEN errors too small to saturate the valve WHEN they last for 100 s THEN each gamma reaches its bound
     * and goes no further */
    start();
    gains.gamma1_max = per_unit(20, TORQUE);
    in.e1 = SCALAR(-2e-5);
    for (int k = 0; k < 100000; k++) {
        in.force = step().F_Ld; /* the inner loop follows */
        TEST_ASSERT_TRUE(absolute(diarc.gamma1) <= gains.gamma1_max);
        TEST_ASSERT_TRUE(absolute(diarc.gamma2) <= gains.gamma2_max);
    }
    TEST_ASSERT_TRUE(diarc.gamma1 == -gains.gamma1_max);

    setUp();
    start();
    gains.kappa1 = GAIN(0);
    in.force -= per_unit(20, FORCE);
    for (int k = 0; k < 100000; k++) {
        (void)step();
        TEST_ASSERT_TRUE(absolute(diarc.gamma2) <= gains.gamma2_max);
    }
    TEST_ASSERT_TRUE(diarc.gamma2 == -gains.gamma2_max);
}

static void test_valve_limit_passed_or_not_reported(void)
{
    /* GIVEN an error that asks for more than the valve has WHEN controlled THEN -1 or 1, and said so */
    for (int sign = -1; sign <= 1; sign += 2) {
        setUp();
        start();
        in.e1 = from_real(sign * 0.3);
        const struct diarc_output out = step();
        TEST_ASSERT_TRUE(real(out.u) == -sign);
        TEST_ASSERT_TRUE(out.saturated);
    }
    setUp();
    start();
    TEST_ASSERT_FALSE(step().saturated);
}

static void test_compensation_winds_up_while_the_valve_is_at_its_limit(void)
{
    /* GIVEN a valve at its limit WHEN that lasts for 1 s THEN both gammas are held; free of it they move
     * again */
    start();
    const struct diarc before = diarc;
    in.e1 = SCALAR(0.3);
    for (int k = 0; k < 1000; k++) {
        TEST_ASSERT_TRUE(step().saturated);
    }
    TEST_ASSERT_TRUE(diarc.gamma1 == before.gamma1);
    TEST_ASSERT_TRUE(diarc.gamma2 == before.gamma2);
    in.e1 = SCALAR(1e-5);
    in.force = try_out(&in).F_Ld;
    TEST_ASSERT_FALSE(step().saturated);
    TEST_ASSERT_TRUE(diarc.gamma1 > before.gamma1);
}

/* What the robust term of step 1 adds to the wanted force, over H e2 / R: its gain in 1/s. */
static double robust_gain_per_s(void)
{
    struct diarc_input off = in;
    off.e1_rate = SCALAR(0.02);
    const double with = si_of(try_out(&off).F_Ld, FORCE);
    const gain most = gains.k2s1_max;
    gains.k2s1_max = GAIN(0);
    const double without = si_of(try_out(&off).F_Ld, FORCE);
    gains.k2s1_max = most;
    return (without - with) * 0.055 / (0.75 * 0.02);
}

static void test_robust_gain_grows_without_bound(void)
{
    /* GIVEN uncertainty from none to absurd WHEN the robust gain of Eq 22 is worked out THEN the paper's
     * square over 4 eta, at most its bound */
    start();
    gains.gamma1_max = per_unit(40, TORQUE);
    diarc.gamma1 = SCALAR(0);
    in.torque_uncertainty = SCALAR(0);
    TEST_ASSERT_DOUBLE_WITHIN(0.03, 40.0 * 40 / 400 / 0.75, robust_gain_per_s());
    in.torque_uncertainty = per_unit(10, TORQUE);
    TEST_ASSERT_DOUBLE_WITHIN(0.03, 50.0 * 50 / 400 / 0.75, robust_gain_per_s());
    in.torque_uncertainty = per_unit(20, TORQUE);
    TEST_ASSERT_DOUBLE_WITHIN(0.03, 10, robust_gain_per_s());
    in.torque_uncertainty = SCALAR(ABSURD);
    TEST_ASSERT_DOUBLE_WITHIN(0.03, 10, robust_gain_per_s());
}

static void test_robust_gain_of_the_flow_grows_without_bound(void)
{
    /* GIVEN absurd uncertainty of the flow WHEN force is off THEN the valve answers with k3 and at most
     * k2s2_max */
    start();
    struct diarc_input off = in;
    off.force += per_unit(1, FORCE);
    off.flow_uncertainty = SCALAR(ABSURD);
    const double most = real(try_out(&off).u);
    gains.k2s2_max = GAIN(0);
    const double none = real(try_out(&off).u);
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, -25 * 1e-9 / 0.9e-3, most - none);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_arm_jumps_when_armed);
    RUN_TEST(test_arm_creeps_after_it_was_armed);
    RUN_TEST(test_start_beyond_the_bounds_of_gamma);
    RUN_TEST(test_adaptation_kicks_the_arm);
    RUN_TEST(test_error_driven_further);
    RUN_TEST(test_error_driven_further_on_a_crank_the_other_way_round);
    RUN_TEST(test_too_much_force_driven_further);
    RUN_TEST(test_feed_forward_of_the_flow_has_the_wrong_sign);
    RUN_TEST(test_rising_torque_not_fed_forward);
    RUN_TEST(test_coupling_term_has_the_wrong_sign);
    RUN_TEST(test_valve_gain_of_the_other_direction);
    RUN_TEST(test_fast_compensation_drives_the_error_up);
    RUN_TEST(test_fast_compensation_beyond_its_bound);
    RUN_TEST(test_valve_limit_passed_or_not_reported);
    RUN_TEST(test_compensation_winds_up_while_the_valve_is_at_its_limit);
    RUN_TEST(test_robust_gain_grows_without_bound);
    RUN_TEST(test_robust_gain_of_the_flow_grows_without_bound);
    return UNITY_END();
}
