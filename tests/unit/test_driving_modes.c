/* The whole ECU (ecu/ecu) tick by tick: SAFE_STOP, HOLD and COMMISSION, the CiA 408 control word, and what a port may ask
 * for. The arm follows its reference with 3 kg. */
#include <stdlib.h>

#include "ecu_bench.h"

void setUp(void)
{
    power_on_with_period(1000);
}

void tearDown(void)
{
}

enum { FULL_SPOOL = 16384, CONTROL_R = 8 };

/* RUN in the middle of a move of both joints, at the greatest rate. */
static void to_the_middle_of_a_move(uint8_t controller)
{
    to_run(controller);
    sensors.follow = true;
    sensors.lag_s = controller == CONTROLLER_PID ? 0.01 : 0; /* it drives by nothing else */
    queue_request(REQUEST_MOVE, SWING, 0, 0.5, 1000);
    queue_request(REQUEST_MOVE, WRIST, 0, -0.2, 1000);
    ticks(500);
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
    TEST_ASSERT_TRUE(abs(spool(SWING)) > 500 && abs(spool(WRIST)) > 500);
}

static void to_mode(enum ecu_mode mode)
{
    setUp();
    switch (mode) {
    case MODE_INIT:
        silence(true);
        queue_nmt(NMT_START, 1);
        ticks(2);
        silence(false);
        break;
    case MODE_FAULT:
        to_fault();
        tick();
        break;
    default:
        to_standby();
        break;
    }
    static const uint8_t request[16] = {[MODE_RUN] = REQUEST_RUN,
                                        [MODE_TARE] = REQUEST_TARE,
                                        [MODE_COMMISSION] = REQUEST_COMMISSION,
                                        [MODE_HOLD] = REQUEST_HOLD,
                                        [MODE_SAFE_STOP] = REQUEST_RUN};
    if (request[mode] != REQUEST_NONE) {
        ask(request[mode]);
        tick();
    }
    if (mode == MODE_SAFE_STOP) {
        ask(REQUEST_SAFE_STOP);
        tick();
    }
    TEST_ASSERT_EQUAL_INT(mode, ecu.mode);
}

/* ---- SAFE_STOP ---- */

/* What may bring it about, in a driving mode. */
enum { BY_STANDBY, BY_REQUEST, BY_PORT, BY_FAULT, WAYS };

static void stop_by(int way)
{
    switch (way) {
    case BY_STANDBY:
        ask(REQUEST_STANDBY);
        break;
    case BY_REQUEST:
        ask(REQUEST_SAFE_STOP);
        break;
    case BY_PORT:
        ecu_request_safe_stop(&ecu);
        break;
    default:
        ecu_note_late_start(&ecu, 100);
        break;
    }
}

static void test_safe_stop_kicks_the_valves_or_takes_another_time(void)
{
    /* GIVEN the middle of a move, each controller WHEN a stop is brought about in each way THEN from the very tick on the
     * set-points go to zero without a step of more than one tick's part of the ramp, never further open, and after 0.2 s
     * STANDBY, or FAULT if it was one; no frame shut the valves before */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        for (int way = 0; way < WAYS; way++) {
            setUp();
            to_the_middle_of_a_move(controller);
            int32_t before[JOINTS] = {spool(SWING), spool(WRIST)};
            const int32_t first[JOINTS] = {before[SWING], before[WRIST]};
            stop_by(way);
            if (way == BY_FAULT) { /* one more tick of the law, whose output is where the ramp begins */
                before[SWING] += before[SWING] / 50;
                before[WRIST] += before[WRIST] / 50;
            }
            for (int k = 1; k < STOP_TICKS; k++) {
                tick();
                TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
                for (uint8_t i = 0; i < JOINTS; i++) {
                    const int32_t now = spool((enum joint)i);
                    TEST_ASSERT_TRUE(abs(now) <= abs(before[i]) + 1);
                    TEST_ASSERT_TRUE(now == 0 || (now > 0) == (first[i] > 0));
                    /* 1.5 / 200 of the whole, model and excess, and rounding */
                    TEST_ASSERT_INT32_WITHIN(3 + abs(first[i]) / 40, before[i], now);
                    before[i] = now;
                }
            }
            TEST_ASSERT_INT32_WITHIN(3, 0, before[SWING]);
            TEST_ASSERT_INT32_WITHIN(3, 0, before[WRIST]);
            tick();
            TEST_ASSERT_EQUAL_INT(way == BY_FAULT ? MODE_FAULT : MODE_STANDBY, ecu.mode);
            TEST_ASSERT_EQUAL_UINT32(DISABLED, get_bits(sent(0x202)->data, 48, 4));
        }
    }
}

static void test_safe_stop_trusts_a_sensor(void)
{
    /* GIVEN the middle of a move WHEN stopped with good sensors, with none, and with sensors that say anything within
     * their ranges THEN the valve frames' set-points are the same, raw step by raw step */
    enum { GOOD, NONE, STRANGE, KINDS };
    for (int way = 0; way < WAYS; way++) {
        static int32_t good[STOP_TICKS][JOINTS];
        for (int kind = 0; kind < KINDS; kind++) {
            setUp();
            to_the_middle_of_a_move(CONTROLLER_DIARC);
            struct lcg noise = {4};
            stop_by(way);
            tick();
            for (int k = 1; k < STOP_TICKS; k++) {
                for (uint8_t i = 0; i < JOINTS; i++) {
                    if (kind == GOOD) {
                        good[k][i] = spool((enum joint)i);
                    }
                    TEST_ASSERT_EQUAL_INT32(good[k][i], spool((enum joint)i));
                }
                silence(kind == NONE);
                sensors.follow = kind != STRANGE;
                for (uint8_t n = 0; kind == STRANGE && n < JOINTS * CHAMBERS; n++) {
                    sensors.pressure[n / CHAMBERS][n % CHAMBERS] = (uint16_t)lcg_uniform(&noise, 0, 39000);
                    sensors.angle[n / CHAMBERS] = angle_raw(lcg_uniform(&noise, -1, 1.2));
                }
                tick();
            }
            TEST_ASSERT_EQUAL_INT(way == BY_FAULT ? MODE_FAULT : MODE_STANDBY, ecu.mode);
        }
    }
}

static void test_lost_sensors_kick_the_valves(void)
{
    /* GIVEN the middle of a move WHEN all sensors are lost for good THEN over the four ticks on prediction and into the
     * safe stop no step of a valve is more than 3 % of full, and it is FAULT after the whole ramp, not before */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        setUp();
        to_the_middle_of_a_move(controller);
        int32_t before[JOINTS] = {spool(SWING), spool(WRIST)};
        silence(true);
        for (int k = 1; k < WRONG_TICKS + STOP_TICKS; k++) {
            tick();
            TEST_ASSERT_EQUAL_INT(k <= WRONG_TICKS ? MODE_RUN : MODE_SAFE_STOP, ecu.mode);
            for (uint8_t i = 0; i < JOINTS; i++) {
                TEST_ASSERT_INT32_WITHIN(FULL_SPOOL * 3 / 100, before[i], spool((enum joint)i));
                before[i] = spool((enum joint)i);
            }
        }
        tick();
        TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    }
}

static void test_safe_stop_outlives_the_network(void)
{
    /* GIVEN a safe stop, with and without a fault WHEN the network is stopped THEN one frame shuts the valves at once,
     * FAULT with a fault, STANDBY without; and no frame after it */
    for (int fault = 0; fault < 2; fault++) {
        setUp();
        to_the_middle_of_a_move(CONTROLLER_DIARC);
        stop_by(fault == 1 ? BY_FAULT : BY_REQUEST);
        ticks(50);
        queue_nmt(NMT_STOP, 0);
        tick();
        TEST_ASSERT_EQUAL_INT(fault == 1 ? MODE_FAULT : MODE_STANDBY, ecu.mode);
        TEST_ASSERT_EQUAL_UINT(1, count_sent(0x202));
        TEST_ASSERT_EQUAL_UINT32(DISABLED, get_bits(sent(0x202)->data, 48, 4));
        tick();
        TEST_ASSERT_NULL(sent(0x202));
    }
}

static void test_safe_stop_goes_on_after_a_graver_fault(void)
{
    /* GIVEN a safe stop WHEN a fault comes whose reaction is valves off THEN FAULT in that very tick; WHEN one comes that
     * would stop it THEN the ramp goes on and ends in FAULT */
    to_the_middle_of_a_move(CONTROLLER_DIARC);
    stop_by(BY_REQUEST);
    ticks(50);
    ecu.master_hash = 1;
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    setUp();
    to_the_middle_of_a_move(CONTROLLER_DIARC);
    stop_by(BY_REQUEST);
    ticks(50);
    fault_raise(&ecu, &PORT, FAULT_OVER_PRESSURE);
    for (int k = 50; k < STOP_TICKS; k++) {
        TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
        tick();
    }
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
}

static void test_request_disturbs_a_safe_stop(void)
{
    /* GIVEN a safe stop WHEN requests come THEN those that start something are refused, STANDBY and SAFE_STOP are not,
     * and the ramp is over when it would have been */
    to_the_middle_of_a_move(CONTROLLER_DIARC);
    stop_by(BY_REQUEST);
    tick();
    static const uint8_t starts[] = {REQUEST_RUN, REQUEST_HOLD, REQUEST_COMMISSION, REQUEST_TARE};
    for (unsigned n = 0; n < COUNT_OF(starts); n++) {
        ask(starts[n]);
        expect_refusal(REFUSAL_STOPPING);
    }
    queue_request(REQUEST_MOVE, SWING, 0, 0.3, 500);
    expect_refusal(REFUSAL_NOT_IN_RUN);
    ask(REQUEST_RESET_FAULT);
    expect_refusal(REFUSAL_NO_FAULT_TO_RESET);
    const uint16_t refused = ecu.counters.refused;
    for (int k = 7; k < STOP_TICKS; k++) {
        TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
        ask(k % 2 == 0 ? REQUEST_STANDBY : REQUEST_SAFE_STOP);
        tick();
    }
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_EQUAL_UINT16(refused, ecu.counters.refused);
}

static void test_port_that_stops_leaves_the_valves_open(void)
{
    /* GIVEN each mode WHEN the port asks for a safe stop and ticks on THEN the valves are shut when it is told so, not
     * while they are driven, and with a bus that takes nothing only with the frame that is taken; a start that waited is
     * forgotten */
    static const enum ecu_mode modes[] = {MODE_INIT,       MODE_STANDBY, MODE_TARE,      MODE_RUN,
                                          MODE_COMMISSION, MODE_HOLD,    MODE_SAFE_STOP, MODE_FAULT};
    for (unsigned n = 0; n < COUNT_OF(modes); n++) {
        to_mode(modes[n]);
        const bool driven = opens_valves(modes[n]);
        TEST_ASSERT_EQUAL_INT(!driven, ecu_valves_shut(&ecu));
        ecu_request_safe_stop(&ecu);
        TEST_ASSERT_EQUAL_INT(driven ? MODE_SAFE_STOP : (modes[n] == MODE_TARE ? MODE_STANDBY : modes[n]),
                              ecu.mode);
        const int left = modes[n] == MODE_SAFE_STOP ? STOP_TICKS - 1 : STOP_TICKS;
        for (int k = 0; driven && k < left; k++) {
            TEST_ASSERT_FALSE(ecu_valves_shut(&ecu));
            bus.full = k >= left - 3;
            tick();
        }
        if (driven) {
            TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
            TEST_ASSERT_FALSE(ecu_valves_shut(&ecu)); /* the frame was not taken */
            bus.full = false;
            tick();
            TEST_ASSERT_EQUAL_UINT32(DISABLED, get_bits(sent(0x202)->data, 48, 4));
        }
        TEST_ASSERT_TRUE(ecu_valves_shut(&ecu));
    }
    to_mode(MODE_STANDBY);
    ask(REQUEST_RUN);
    bus.sent_count = 0;
    ecu_tick_begin(&ecu, &PORT);
    queue_sensors();
    (void)ecu_tick_receive(&ecu, &PORT);
    TEST_ASSERT_TRUE(ecu.is_pending);
    ecu_request_safe_stop(&ecu);
    ecu_tick_end(&ecu, &PORT);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
}

/* ---- HOLD ---- */

static struct reference reference_of(enum joint i)
{
    return ecu.controller.output[i].reference;
}

static void test_hold_does_not_brake_smoothly_on_the_path(void)
{
    /* GIVEN the middle of a move WHEN HOLD is asked for THEN both references go on along their paths, with rate and
     * acceleration that do not step, and are at rest within 0.2 s; there they stay, valves driven, Moving false */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        setUp();
        to_the_middle_of_a_move(controller);
        struct reference before[JOINTS] = {reference_of(SWING), reference_of(WRIST)};
        const double peak[JOINTS] = {real(before[SWING].w), real(before[WRIST].w)};
        ask(REQUEST_HOLD);
        for (int k = 0; k <= STOP_TICKS; k++) {
            tick();
            TEST_ASSERT_EQUAL_INT(MODE_HOLD, ecu.mode);
            for (uint8_t i = 0; i < JOINTS; i++) {
                const struct reference now = reference_of((enum joint)i);
                const double sign = i == SWING ? 1 : -1;
                TEST_ASSERT_TRUE(sign * real(now.q) >= sign * real(before[i].q) - 1e-6);
                /* |sigma'| <= 1.5 / 0.2 s, |sigma''| <= 6 / (0.2 s)^2, and the move's own at its middle: no acceleration,
                 * s''' = -52.5 distance / T^3, a quarter more for both at once */
                TEST_ASSERT_DOUBLE_WITHIN(1.25 * 7.5e-3 * fabs(peak[i]), real(before[i].w), real(now.w));
                TEST_ASSERT_DOUBLE_WITHIN(1.25 * (150 + 24) * 1e-3 * fabs(peak[i]), real(before[i].a),
                                          real(now.a));
                before[i] = now;
            }
        }
        for (uint8_t i = 0; i < JOINTS; i++) {
            TEST_ASSERT_TRUE(before[i].w == SCALAR(0) && before[i].a == SCALAR(0));
        }
        TEST_ASSERT_TRUE(real(before[SWING].q) > 0.3 && real(before[SWING].q) < 0.5);
        ticks(300);
        TEST_ASSERT_TRUE(reference_of(SWING).q == before[SWING].q &&
                         reference_of(WRIST).q == before[WRIST].q);
        TEST_ASSERT_EQUAL_UINT32(0, get_bits(wait_for(0x181, 0, 8, -1), 60, 1));
        TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
    }
}

static void test_valve_kicked_by_hold_or_run(void)
{
    /* GIVEN the middle of a move WHEN HOLD, and later RUN is asked for THEN no valve steps by more than 1 % in those
     * ticks, and reference, estimate and controller go on as they are */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        setUp();
        to_the_middle_of_a_move(controller);
        for (int n = 0; n < 2; n++) {
            const int32_t before[JOINTS] = {spool(SWING), spool(WRIST)};
            queue_request(n == 0 ? REQUEST_HOLD : REQUEST_RUN, 0, CONTROLLER_PID, 0, 1);
            tick();
            TEST_ASSERT_EQUAL_INT(n == 0 ? MODE_HOLD : MODE_RUN, ecu.mode);
            TEST_ASSERT_INT32_WITHIN(FULL_SPOOL / 100, before[SWING], spool(SWING));
            TEST_ASSERT_INT32_WITHIN(FULL_SPOOL / 100, before[WRIST], spool(WRIST));
            TEST_ASSERT_EQUAL_INT(controller, ecu.controller.kind); /* a request under way cannot change it */
            TEST_ASSERT_EQUAL_INT(controller, ecu.requested_controller);
            if (n == 0) {
                ticks(STOP_TICKS + 300);
            }
        }
        const scalar q = reference_of(WRIST).q;
        ticks(50);
        TEST_ASSERT_TRUE(reference_of(WRIST).q == q);
        queue_request(REQUEST_MOVE, WRIST, 0, 0.1, 1000);
        ticks(1001);
        TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0.1, real(reference_of(WRIST).q));
        TEST_ASSERT_EQUAL_UINT16(0, ecu.counters.refused);
    }
}

static void test_move_taken_while_held_or_braking(void)
{
    /* GIVEN HOLD WHEN a move is asked for THEN refused; RUN in the middle of the brake lets the brake end first, and only
     * then takes a move. HOLD asked for again changes nothing */
    to_the_middle_of_a_move(CONTROLLER_DIARC);
    ask(REQUEST_HOLD);
    ticks(50);
    queue_request(REQUEST_MOVE, SWING, 0, 0.1, 1000);
    expect_refusal(REFUSAL_NOT_IN_RUN);
    ask(REQUEST_HOLD);
    tick();
    TEST_ASSERT_EQUAL_UINT16(52, ecu.controller.trajectory[SWING].brake_tick);
    ask(REQUEST_RUN);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    queue_request(REQUEST_MOVE, SWING, 0, 0.1, 1000);
    expect_refusal(REFUSAL_MOVE_UNDER_WAY);
    ticks(STOP_TICKS - 54);
    TEST_ASSERT_FALSE(trajectory_moving(&ecu.controller.trajectory[SWING]));
    queue_request(REQUEST_MOVE, SWING, 0, 0.1, 1000);
    tick();
    TEST_ASSERT_TRUE(trajectory_moving(&ecu.controller.trajectory[SWING]));
}

static void test_arm_jumps_when_held_from_standby(void)
{
    /* GIVEN STANDBY WHEN HOLD is asked for, with each controller THEN the arm is held where it is, no valve opens by more
     * than 1 %; a pushed arm is drawn back */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        setUp();
        to_standby();
        queue_request(REQUEST_HOLD, 0, controller, 0, 1);
        for (int k = 0; k < 100; k++) {
            tick();
            TEST_ASSERT_EQUAL_INT(MODE_HOLD, ecu.mode);
            TEST_ASSERT_EQUAL_INT(controller, ecu.controller.kind);
            TEST_ASSERT_INT32_WITHIN(164, 0, spool(SWING));
            TEST_ASSERT_INT32_WITHIN(164, 0, spool(WRIST));
        }
        push(SWING, 5e-3);
        ticks(5);
        TEST_ASSERT_TRUE(spool(SWING) < -100);
    }
    to_mode(MODE_STANDBY);
    queue_request(REQUEST_HOLD, 0, CONTROLLERS, 0, 1);
    expect_refusal(REFUSAL_UNKNOWN_REQUEST);
    queue_request(REQUEST_COMMISSION, 0, CONTROLLERS, 0, 1);
    expect_refusal(REFUSAL_UNKNOWN_REQUEST);
}

/* ---- COMMISSION ---- */

static void test_load_learned_while_commissioning(void)
{
    /* GIVEN COMMISSION of an arm that carries 3 kg all the same WHEN it makes moves THEN the load on ESTIMATE is 0 without
     * deviation all the way, nothing reopens it, the other parameters are open; HOLD and RUN are refused */
    to_mode(MODE_COMMISSION);
    sensors.follow = true;
    const scalar sd_before = estimator_sd_m(&ecu.controller.estimator, &ecu.constants.estimator, FV1);
    TEST_ASSERT_DOUBLE_WITHIN(1e-3, 0.25, real(sd_before) / real(ecu.constants.estimator.scale_m[FV1]));
    for (int n = 0; n < 4; n++) {
        queue_request(REQUEST_MOVE, SWING, 0, n % 2 == 0 ? 0.5 : 0.1, 1000);
        queue_request(REQUEST_MOVE, WRIST, 0, n % 2 == 0 ? -0.2 : 0.1, 1000);
        for (int k = 0; k < 1001; k++) {
            tick();
            TEST_ASSERT_EQUAL_INT(MODE_COMMISSION, ecu.mode);
            TEST_ASSERT_TRUE(ecu.controller.estimator.theta_m[M_T] == SCALAR(0));
            const struct can_frame_11bit *const estimate = sent(0x181);
            if (estimate != NULL) {
                TEST_ASSERT_EQUAL_INT32(0, get_signed(estimate->data, 16, 24));
                TEST_ASSERT_EQUAL_UINT32(0, get_bits(estimate->data, 40, 16));
            }
        }
    }
    TEST_ASSERT_EQUAL_UINT16(0, ecu.counters.refused);
    TEST_ASSERT_EQUAL_UINT16(0, ecu.controller.estimator.reopened);
    TEST_ASSERT_TRUE(estimator_sd_m(&ecu.controller.estimator, &ecu.constants.estimator, FV1) < sd_before);
    static const uint8_t starts[] = {REQUEST_RUN, REQUEST_HOLD, REQUEST_COMMISSION, REQUEST_TARE};
    for (unsigned n = 0; n < COUNT_OF(starts); n++) {
        ask(starts[n]);
        expect_refusal(REFUSAL_NOT_IN_STANDBY);
    }
}

static void test_operation_forgets_what_was_commissioned(void)
{
    /* GIVEN what COMMISSION has found WHEN the arm is stopped, and run or held THEN it is kept, as sure as the priors say,
     * and the load is its prior and open again; RUN after RUN keeps the load as well; COMMISSION again opens all anew */
    static const uint8_t starts[] = {REQUEST_RUN, REQUEST_HOLD};
    for (unsigned n = 0; n < COUNT_OF(starts); n++) {
        to_mode(MODE_COMMISSION);
        struct estimator *const estimator = &ecu.controller.estimator;
        const struct estimator_constants *const constants = &ecu.constants.estimator;
        const struct prior *const m = ecu.machine.estimator.m;
        const scalar fv1 = m[FV1].value + per_unit(3, base_torque(&ecu.bases));
        estimator->theta_m[FV1] = fv1;
        const scalar open_sd = estimator_sd_m(estimator, constants, FV1);
        ask(REQUEST_STANDBY);
        ticks(STOP_TICKS);
        TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
        TEST_ASSERT_TRUE(estimator->theta_m[M_T] == SCALAR(0)); /* until the arm is used */
        ask(starts[n]);
        tick();
        TEST_ASSERT_TRUE(opens_valves(ecu.mode));
        TEST_ASSERT_TRUE(estimator->theta_m[FV1] == fv1);
        TEST_ASSERT_DOUBLE_WITHIN(1e-2 * real(m[FV1].sd), real(m[FV1].sd),
                                  real(estimator_sd_m(estimator, constants, FV1)));
        TEST_ASSERT_TRUE(estimator->theta_m[M_T] == m[M_T].value);
        TEST_ASSERT_DOUBLE_WITHIN(1e-2 * real(m[M_T].sd), real(m[M_T].sd),
                                  real(estimator_sd_m(estimator, constants, M_T)));
        estimator->theta_m[M_T] = per_unit(2, base_torque(&ecu.bases));
        ask(REQUEST_STANDBY);
        ticks(STOP_TICKS);
        ask(REQUEST_RUN);
        tick();
        TEST_ASSERT_TRUE(estimator->theta_m[M_T] == per_unit(2, base_torque(&ecu.bases)));
        ask(REQUEST_STANDBY);
        ticks(STOP_TICKS);
        ask(REQUEST_COMMISSION);
        tick();
        TEST_ASSERT_TRUE(estimator->theta_m[M_T] == SCALAR(0));
        TEST_ASSERT_TRUE(estimator->theta_m[FV1] == fv1);
        TEST_ASSERT_TRUE(estimator_sd_m(estimator, constants, FV1) == open_sd);
    }
}

/* ---- requests that meet ---- */

static void test_earlier_of_two_starts_wins(void)
{
    /* GIVEN STANDBY WHEN two starts come within one tick THEN the later counts; a tare after a start is refused */
    to_mode(MODE_STANDBY);
    ask(REQUEST_RUN);
    ask(REQUEST_HOLD);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_HOLD, ecu.mode);
    to_mode(MODE_STANDBY);
    ask(REQUEST_COMMISSION);
    ask(REQUEST_TARE);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_COMMISSION, ecu.mode);
    TEST_ASSERT_EQUAL_UINT16(1, ecu.counters.refused);
    TEST_ASSERT_EQUAL_INT(REFUSAL_NOT_IN_STANDBY, ecu.counters.last_refusal);
}

static void test_count_of_refusals_starts_again(void)
{
    /* GIVEN counters at their ends WHEN one more comes THEN they stay there */
    to_mode(MODE_STANDBY);
    ecu.counters.refused = UINT16_MAX;
    ecu.counters.late_ticks = UINT16_MAX;
    ecu.counters.send_drops = UINT16_MAX;
    ask(REQUEST_RESET_FAULT);
    silence(true);
    bus.full = true;
    tick();
    TEST_ASSERT_EQUAL_UINT16(UINT16_MAX, ecu.counters.refused);
    TEST_ASSERT_EQUAL_UINT16(UINT16_MAX, ecu.counters.late_ticks);
    TEST_ASSERT_EQUAL_UINT16(UINT16_MAX, ecu.counters.send_drops);
}

/* ---- CiA 408 control word ---- */

/* Where the word leads by the next tick's end, written down on its own; refusal is what the writer is told. */
static enum ecu_mode expected_of(enum ecu_mode mode, unsigned word, bool rising, enum ecu_refusal *refusal)
{
    *refusal = REFUSAL_NONE;
    if (mode == MODE_FAULT && rising) {
        mode = MODE_STANDBY;
    }
    const bool stopping = mode == MODE_SAFE_STOP;
    const enum ecu_refusal misplaced = stopping ? REFUSAL_STOPPING : REFUSAL_NOT_IN_STANDBY;
    switch (word & 7u) {
    case 7: /* ACTIVE */
        if (mode == MODE_STANDBY || mode == MODE_HOLD) {
            return MODE_RUN;
        }
        *refusal = mode == MODE_RUN || mode == MODE_COMMISSION ? REFUSAL_NONE : misplaced;
        break;
    case 3: /* HOLD */
        if (mode == MODE_STANDBY || mode == MODE_RUN) {
            return MODE_HOLD;
        }
        *refusal = mode == MODE_HOLD ? REFUSAL_NONE : misplaced;
        break;
    case 1: /* DISABLED */
    case 0: /* INIT: nothing of what DISABLED would not do */
        if (opens_valves(mode)) {
            return MODE_SAFE_STOP;
        }
        return mode == MODE_TARE ? MODE_STANDBY : mode;
    default:
        *refusal = REFUSAL_UNKNOWN_REQUEST;
        break;
    }
    return mode;
}

static void test_control_word_leads_elsewhere(void)
{
    /* GIVEN every mode, every word of the low four bits with R rising and not, and other bits that mean nothing here WHEN
     * written THEN the modes and refusals of the rules */
    static const enum ecu_mode modes[] = {MODE_INIT,       MODE_STANDBY, MODE_TARE,      MODE_RUN,
                                          MODE_COMMISSION, MODE_HOLD,    MODE_SAFE_STOP, MODE_FAULT};
    static const uint16_t others[] = {0, 0xFFF0, 0x0050};
    for (unsigned m = 0; m < COUNT_OF(modes); m++) {
        for (unsigned n = 0; n < 16u * 2u * COUNT_OF(others); n++) {
            const uint16_t word = (uint16_t)(n % 16u + others[n / 32u]);
            const bool was_high = n / 16u % 2u == 1u;
            to_mode(modes[m]);
            silence(modes[m] == MODE_INIT);
            ecu.control_word = was_high ? CONTROL_R : 0;
            enum ecu_refusal refusal;
            const enum ecu_mode expected =
                expected_of(modes[m], word, (word & CONTROL_R) != 0u && !was_high, &refusal);
            char which[64];
            (void)snprintf(which, sizeof which, "mode %d word 0x%04X", (int)modes[m], word);
            TEST_ASSERT_EQUAL_INT_MESSAGE(refusal, request_control_word(&ecu, &PORT, word), which);
            TEST_ASSERT_EQUAL_HEX16(word, ecu.control_word); /* no reset is refused here: nothing is wrong */
            tick();
            TEST_ASSERT_EQUAL_INT_MESSAGE(expected, ecu.mode, which);
        }
    }
}

static void test_control_word_resets_a_fault_that_is_still_there(void)
{
    /* GIVEN FAULT with its cause WHEN the word resets and asks for ACTIVE THEN refused, nothing done, as often as it is
     * tried; the same word resets once the cause has gone. A word without the bit in between changes nothing */
    to_mode(MODE_FAULT);
    ecu.master_hash = 1;
    TEST_ASSERT_EQUAL_INT(REFUSAL_CAUSE_PERSISTS, request_control_word(&ecu, &PORT, 0xF));
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    TEST_ASSERT_EQUAL_INT(REFUSAL_CAUSE_PERSISTS, request_control_word(&ecu, &PORT, 0xF));
    TEST_ASSERT_EQUAL_INT(REFUSAL_NOT_IN_STANDBY, request_control_word(&ecu, &PORT, 0x7));
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    ecu.master_hash = 0;
    TEST_ASSERT_EQUAL_INT(REFUSAL_NONE, request_control_word(&ecu, &PORT, 0xF));
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

static void test_control_word_obeyed_before_the_network_is_started(void)
{
    /* GIVEN a network not started WHEN the word asks for ACTIVE or HOLD THEN refused; a fault may be reset, to INIT */
    to_mode(MODE_STANDBY);
    queue_nmt(NMT_PRE_OP, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(REFUSAL_NOT_OPERATIONAL, request_control_word(&ecu, &PORT, 0x7));
    TEST_ASSERT_EQUAL_INT(REFUSAL_NOT_OPERATIONAL, request_control_word(&ecu, &PORT, 0x3));
    to_mode(MODE_FAULT);
    queue_nmt(NMT_PRE_OP, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    TEST_ASSERT_EQUAL_INT(REFUSAL_NONE, request_control_word(&ecu, &PORT, 0x9));
    TEST_ASSERT_EQUAL_INT(MODE_INIT, ecu.mode);
    TEST_ASSERT_EQUAL_HEX32(0, ecu.active_faults);
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_safe_stop_kicks_the_valves_or_takes_another_time);
    RUN_TEST(test_safe_stop_trusts_a_sensor);
    RUN_TEST(test_lost_sensors_kick_the_valves);
    RUN_TEST(test_safe_stop_outlives_the_network);
    RUN_TEST(test_safe_stop_goes_on_after_a_graver_fault);
    RUN_TEST(test_request_disturbs_a_safe_stop);
    RUN_TEST(test_port_that_stops_leaves_the_valves_open);
    RUN_TEST(test_hold_does_not_brake_smoothly_on_the_path);
    RUN_TEST(test_valve_kicked_by_hold_or_run);
    RUN_TEST(test_move_taken_while_held_or_braking);
    RUN_TEST(test_arm_jumps_when_held_from_standby);
    RUN_TEST(test_load_learned_while_commissioning);
    RUN_TEST(test_operation_forgets_what_was_commissioned);
    RUN_TEST(test_earlier_of_two_starts_wins);
    RUN_TEST(test_count_of_refusals_starts_again);
    RUN_TEST(test_control_word_leads_elsewhere);
    RUN_TEST(test_control_word_resets_a_fault_that_is_still_there);
    RUN_TEST(test_control_word_obeyed_before_the_network_is_started);
    return UNITY_END();
}
