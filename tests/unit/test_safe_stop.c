/* The ramp of a safe stop (control/safe_stop) on the reference arm: from a moving joint to shut valves, on the model. */
#include "control/safe_stop.h"
#include "testing.h"

/* Of set-points of order one. */
#define TOLERANCE BY_TYPE(1e-14, 2e-6, 2e-5)

enum { TICKS = 200 };

static struct machine machine;
static struct bases bases;
static struct controller_constants constants;
static struct controller controller;
static struct measurement at;

/* The arm at 0.1 rad under 3 kg, swing forward at 0.4 rad/s, wrist back at 0.3, the law's set-points near what that
 * takes. */
void setUp(void)
{
    load_reference_arm(&machine, &bases);
    controller_constants(&constants, &machine, SCALAR(0.001));
    controller_start(&controller, &machine, &constants);
    at = (struct measurement){.q = {SCALAR(0.1), SCALAR(0.1)}};
    static const double bar[JOINTS][CHAMBERS] = {{50, 73.14}, {42.06, 50}};
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        const double p_Pa = bar[n / CHAMBERS][n % CHAMBERS] * 1e5;
        at.p[n / CHAMBERS][n % CHAMBERS] = per_unit(p_Pa, bases.pressure);
    }
    for (uint8_t i = 0; i < JOINTS; i++) {
        machine.cylinder[i].overlap = SCALAR(0.02);
    }
    controller.armed = true;
    controller.output[SWING].reference.w = SCALAR(0.4);
    controller.output[WRIST].reference.w = SCALAR(-0.3);
    controller.output[SWING].u = SCALAR(0.35);
    controller.output[WRIST].u = SCALAR(-0.4);
}

void tearDown(void)
{
}

static double smooth(double x)
{
    return 1 - x * x * (3 - 2 * x);
}

/* The set-point that the model gives to rate w, in real numbers: QL = lamA R w by the root law, overlap bridged. */
static double model(enum joint i, double w)
{
    const struct cylinder *const cylinder = &machine.cylinder[i];
    const struct cylinder_state state = cylinder_at(cylinder, &constants.cylinder[i], at.q[i]);
    const double QL = real(state.lamA) * real(state.R) * w;
    const double p1 = real(at.p[i][BORE]);
    const double p2 = real(at.p[i][ANNULUS]);
    const double ps = real(machine.supply.p_supply);
    const double pt = real(machine.supply.p_tank);
    const double drop1 = QL >= 0 ? ps - p1 : p1 - pt;
    const double drop2 = QL >= 0 ? p2 - pt : ps - p2;
    const double kv = real(cylinder->kv);
    const double per_root = real(state.lamB) * sqrt(drop1) + real(state.lamC) * sqrt(drop2);
    const double opening = QL / (kv * per_root);
    return opening + real(cylinder->overlap) * fmin(fmax(opening / 0.005, -1), 1);
}

static void test_set_points_are_not_the_models(void)
{
    /* GIVEN a moving arm WHEN it is stopped THEN each tick's set-point is what the model takes for the rate of that tick,
     * and the law's excess over it at the start, faded; each of the two reported once over after all ticks */
    double extra[JOINTS];
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct joint_output *const out = &controller.output[i];
        extra[i] = real(out->u) - model((enum joint)i, real(out->reference.w));
    }
    struct safe_stop stop = safe_stop_start(&controller, &machine, &constants, &at, TICKS);
    for (int k = 1; k <= TICKS; k++) {
        scalar u[JOINTS];
        TEST_ASSERT_EQUAL_INT(k == TICKS, safe_stop_step(&stop, &machine, &constants, u));
        const double share = smooth((double)k / TICKS);
        for (uint8_t i = 0; i < JOINTS; i++) {
            const double w = share * real(controller.output[i].reference.w);
            const double expected = k == TICKS ? 0 : model((enum joint)i, w) + share * extra[i];
            TEST_ASSERT_DOUBLE_WITHIN(100 * TOLERANCE, expected, real(u[i]));
        }
    }
}

static void test_valve_is_kicked_when_the_stop_begins_or_ends(void)
{
    /* GIVEN set-points of all sizes, the model's or not WHEN the stop runs THEN no step of the whole way, from the law's
     * last set-point to zero, is more than the smooth step's greatest slope, 1.5, and the overlap bridged allow */
    struct lcg noise = {11};
    for (int n = 0; n < 200; n++) {
        for (uint8_t i = 0; i < JOINTS; i++) {
            controller.output[i].reference.w = from_real(lcg_uniform(&noise, -0.8, 0.8));
            controller.output[i].u = from_real(lcg_uniform(&noise, -1, 1));
        }
        struct safe_stop stop = safe_stop_start(&controller, &machine, &constants, &at, TICKS);
        double before[JOINTS] = {real(controller.output[SWING].u), real(controller.output[WRIST].u)};
        double most[JOINTS];
        for (uint8_t i = 0; i < JOINTS; i++) {
            const enum joint joint = (enum joint)i;
            const double w = real(controller.output[i].reference.w);
            const double opening = fabs(model(joint, w)) + 1e-9;
            const double bridged = 1 + real(machine.cylinder[i].overlap) / 0.005;
            most[i] = 1.5 / TICKS * (opening * bridged + fabs(real(stop.extra[i]))) + 1e-6;
        }
        for (int k = 1; k <= TICKS; k++) {
            scalar u[JOINTS];
            (void)safe_stop_step(&stop, &machine, &constants, u);
            for (uint8_t i = 0; i < JOINTS; i++) {
                TEST_ASSERT_TRUE(fabs(real(u[i]) - before[i]) <= most[i]);
                before[i] = real(u[i]);
            }
        }
        TEST_ASSERT_TRUE(before[SWING] == 0 && before[WRIST] == 0);
    }
}

static void test_valve_opens_further_on_the_way_to_shut(void)
{
    /* GIVEN set-points on the model's side of it or beyond WHEN the stop runs THEN they only ever come nearer to zero */
    for (int sign = -1; sign <= 1; sign += 2) {
        for (int n = 0; n <= 10; n++) {
            for (uint8_t i = 0; i < JOINTS; i++) {
                const double w = sign * 0.05 * n;
                controller.output[i].reference.w = from_real(w);
                controller.output[i].u = from_real(sign * fmin(1, fabs(model((enum joint)i, w)) + 0.02 * n));
            }
            struct safe_stop stop = safe_stop_start(&controller, &machine, &constants, &at, TICKS);
            double before[JOINTS] = {fabs(real(controller.output[SWING].u)),
                                     fabs(real(controller.output[WRIST].u))};
            for (int k = 1; k <= TICKS; k++) {
                scalar u[JOINTS];
                (void)safe_stop_step(&stop, &machine, &constants, u);
                for (uint8_t i = 0; i < JOINTS; i++) {
                    TEST_ASSERT_TRUE(sign * real(u[i]) >= -TOLERANCE);
                    TEST_ASSERT_TRUE(fabs(real(u[i])) <= before[i] + TOLERANCE);
                    before[i] = fabs(real(u[i]));
                }
            }
        }
    }
}

static void test_arm_at_rest_is_moved_by_its_stop(void)
{
    /* GIVEN an arm held at rest by shut valves WHEN stopped THEN they stay shut, exactly */
    for (uint8_t i = 0; i < JOINTS; i++) {
        controller.output[i] = (struct joint_output){.u = SCALAR(0)};
    }
    struct safe_stop stop = safe_stop_start(&controller, &machine, &constants, &at, TICKS);
    for (int k = 1; k <= TICKS; k++) {
        scalar u[JOINTS];
        (void)safe_stop_step(&stop, &machine, &constants, u);
        TEST_ASSERT_TRUE(u[SWING] == SCALAR(0) && u[WRIST] == SCALAR(0));
    }
}

static void test_stop_over_too_early_or_started_again(void)
{
    /* GIVEN stops of 1 tick, 2 and as many as a machine may have WHEN their ticks have passed THEN over, not one tick
     * before, with zero; and it stays so */
    static const uint16_t lengths[] = {1, 2, 7, 8000};
    for (unsigned n = 0; n < COUNT_OF(lengths); n++) {
        struct safe_stop stop = safe_stop_start(&controller, &machine, &constants, &at, lengths[n]);
        for (unsigned k = 1; k <= lengths[n] + 100u; k++) {
            scalar u[JOINTS];
            const bool over = safe_stop_step(&stop, &machine, &constants, u);
            TEST_ASSERT_EQUAL_INT(k >= lengths[n], over);
            if (over) {
                TEST_ASSERT_TRUE(u[SWING] == SCALAR(0) && u[WRIST] == SCALAR(0));
            }
        }
    }
}

static void test_set_point_beyond_fully_open(void)
{
    /* GIVEN rates that no valve gives, and pressures that leave it no drop WHEN stopped THEN -1..1 all the way */
    controller.output[SWING].reference.w = SCALAR(4);
    controller.output[WRIST].reference.w = SCALAR(-4);
    controller.output[SWING].u = SCALAR(1);
    controller.output[WRIST].u = SCALAR(1); /* against the rate */
    at.p[SWING][BORE] = machine.supply.p_supply;
    at.p[SWING][ANNULUS] = machine.supply.p_tank;
    struct safe_stop stop = safe_stop_start(&controller, &machine, &constants, &at, TICKS);
    for (int k = 1; k <= TICKS; k++) {
        scalar u[JOINTS];
        (void)safe_stop_step(&stop, &machine, &constants, u);
        for (uint8_t i = 0; i < JOINTS; i++) {
            TEST_ASSERT_TRUE(u[i] >= SCALAR(-1) && u[i] <= SCALAR(1));
        }
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_set_points_are_not_the_models);
    RUN_TEST(test_valve_is_kicked_when_the_stop_begins_or_ends);
    RUN_TEST(test_valve_opens_further_on_the_way_to_shut);
    RUN_TEST(test_arm_at_rest_is_moved_by_its_stop);
    RUN_TEST(test_stop_over_too_early_or_started_again);
    RUN_TEST(test_set_point_beyond_fully_open);
    return UNITY_END();
}
