/* The whole ECU (ecu/ecu) tick by tick: what each mode does, what requests lead to, and the tare. */
#include "ecu_bench.h"

void setUp(void)
{
    power_on_with_period(1000);
}

void tearDown(void)
{
}

static void test_valves_commanded_before_the_network_is_started(void)
{
    /* GIVEN an ECU just on, sensors good WHEN the network is not started THEN it stays in INIT and sends SYNC
     * and heartbeats alone */
    tick();
    for (int k = 0; k < 300; k++) {
        tick();
        TEST_ASSERT_EQUAL_INT(MODE_INIT, ecu.mode);
        for (unsigned n = 0; n < bus.sent_count; n++) {
            TEST_ASSERT_TRUE(bus.sent[n].id == 0x80u || bus.sent[n].id == 0x701u);
        }
    }
}

static void test_standby_without_sensors(void)
{
    /* GIVEN the network started WHEN any one sensor frame is missing THEN INIT; WHEN all come THEN STANDBY */
    queue_nmt(NMT_START, 1);
    for (uint8_t n = 0; n < 3u; n++) {
        silence(false);
        sensors.silent[n] = true;
        ticks(5);
        TEST_ASSERT_EQUAL_INT(MODE_INIT, ecu.mode);
    }
    silence(false);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
}

static void test_standby_outlives_the_sensors(void)
{
    /* GIVEN STANDBY WHEN the sensors fall silent for more than 4 ticks THEN back to INIT, no fault, and to
     * STANDBY again when they come back */
    to_standby();
    silence(true);
    ticks(WRONG_TICKS);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_INIT, ecu.mode);
    TEST_ASSERT_EQUAL_INT(FAULT_NONE, ecu.fault);
    silence(false);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
}

static void test_run_not_entered_or_valves_not_enabled(void)
{
    /* GIVEN STANDBY WHEN each controller is asked for THEN RUN in that very tick, valves enabled, nothing
     * refused */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        setUp();
        to_run(controller);
        TEST_ASSERT_EQUAL_INT(controller, ecu.controller.kind);
        TEST_ASSERT_EQUAL_UINT32(ACTIVE, get_bits(sent(0x202)->data, 48, 4));
        TEST_ASSERT_EQUAL_UINT16(0, ecu.counters.refused);
    }
}

static void test_arm_jumps_when_armed(void)
{
    /* GIVEN an arm at rest under load WHEN armed THEN no valve opens by more than 1 %, now and for 0.1 s */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        setUp();
        to_run(controller);
        for (int k = 0; k < 100; k++) {
            TEST_ASSERT_INT32_WITHIN(164, 0, spool(SWING));
            TEST_ASSERT_INT32_WITHIN(164, 0, spool(WRIST));
            tick();
        }
    }
}

static void test_standby_request_ignored(void)
{
    /* GIVEN RUN with an open valve WHEN STANDBY is asked for THEN a safe stop of 0.2 s, at its end valves zero and
     * disabled, and the next RUN starts afresh, where the arm is now and with the force it has now */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        setUp();
        to_run(controller);
        ticks(5);
        push(SWING, 0.01);
        ticks(200);
        TEST_ASSERT_TRUE(spool(SWING) < -100);
        queue_request(REQUEST_STANDBY, 0, 0, 0, 1);
        for (int k = 0; k < STOP_TICKS; k++) {
            TEST_ASSERT_EQUAL_INT(k == 0 ? MODE_RUN : MODE_SAFE_STOP, ecu.mode);
            tick();
        }
        TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
        TEST_ASSERT_EQUAL_INT32(0, spool(SWING));
        TEST_ASSERT_EQUAL_INT32(0, get_signed(wait_for(0x281, 16, 4, SWING), 20, 20));    /* nor any error */
        sensors.pressure[WRIST][BORE] = (uint16_t)(sensors.pressure[WRIST][BORE] + 1000); /* 5 bar */
        queue_request(REQUEST_RUN, 0, controller, 0, 1);
        tick();
        TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
        TEST_ASSERT_INT32_WITHIN(164, 0, spool(SWING));
        TEST_ASSERT_INT32_WITHIN(164, 0, spool(WRIST));
    }
}

static void test_load_compensated_where_it_must_not_be(void)
{
    /* GIVEN two machines whose load is pinned, to 0 and to 5 kg WHEN both make a move THEN DIARC drives their
     * valves differently, DIARC_NOLOAD the same, bit for bit */
    for (uint8_t controller = CONTROLLER_DIARC_NOLOAD; controller <= CONTROLLER_DIARC; controller++) {
        int32_t spools[2][JOINTS];
        for (int n = 0; n < 2; n++) {
            static const uint32_t value_bits[2] = {0, 0x40A00000u}; /* 0, 5 */
            struct parameter_image image = default_parameter_image;
            uint16_t entry;
            image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * entry_named("estimator.prior.m_t_kg.value"),
                          value_bits[n]);
            image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * entry_named("estimator.prior.m_t_kg.sd"), 0);
            image_seal(&image);
            setUp();
            TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, &image, 1000, &entry));
            to_run(controller);
            queue_request(REQUEST_MOVE, WRIST, 0, 0.5, 1000);
            queue_request(REQUEST_MOVE, SWING, 0, 0.5, 1000);
            ticks(100);
            spools[n][SWING] = spool(SWING);
            spools[n][WRIST] = spool(WRIST);
        }
        const bool same = spools[0][SWING] == spools[1][SWING] && spools[0][WRIST] == spools[1][WRIST];
        TEST_ASSERT_EQUAL_INT(controller == CONTROLLER_DIARC_NOLOAD, same);
    }
}

static void test_run_wins_over_a_later_standby(void)
{
    /* GIVEN STANDBY WHEN RUN and then STANDBY are asked for within one tick THEN the last word counts */
    to_standby();
    queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
    queue_request(REQUEST_STANDBY, 0, 0, 0, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_EQUAL_UINT32(DISABLED, get_bits(sent(0x202)->data, 48, 4));
}

static void test_run_wins_over_a_network_stop(void)
{
    /* GIVEN STANDBY WHEN RUN is asked for and the network is stopped within one tick THEN the ECU does not
     * run, now or when the network is started again */
    static const uint8_t stops[] = {NMT_STOP, NMT_PRE_OP};
    for (unsigned n = 0; n < COUNT_OF(stops); n++) {
        setUp();
        to_standby();
        queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
        queue_nmt(stops[n], 0);
        tick();
        TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
        queue_nmt(NMT_START, 0);
        tick();
        TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    }
}

static void test_network_stop_leaves_the_arm_running(void)
{
    /* GIVEN RUN WHEN the network is stopped, or brought to pre-operational THEN STANDBY, one last frame that
     * shuts the valves and no process frames after it, the state in the heartbeat; started again it does not run
     * by itself */
    static const uint8_t stops[] = {NMT_STOP, NMT_PRE_OP};
    static const enum nmt_state states[] = {NMT_STOPPED, NMT_PRE_OPERATIONAL};
    for (unsigned n = 0; n < COUNT_OF(stops); n++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        queue_nmt(stops[n], 0);
        tick();
        TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
        TEST_ASSERT_FALSE(ecu.controller.armed);
        TEST_ASSERT_EQUAL_INT(states[n], ecu.nmt);
        TEST_ASSERT_EQUAL_UINT(1, count_sent(0x202));
        TEST_ASSERT_EQUAL_UINT32(DISABLED, get_bits(sent(0x202)->data, 48, 4));
        unsigned beats = 0;
        for (int k = 0; k < 200; k++) {
            tick();
            TEST_ASSERT_NULL(sent(0x181));
            TEST_ASSERT_NULL(sent(0x202));
            const struct can_frame_11bit *const beat = sent(0x701);
            if (beat != NULL) {
                TEST_ASSERT_EQUAL_UINT8(states[n], beat->data[0]);
                beats++;
            }
        }
        TEST_ASSERT_EQUAL_UINT(2, beats);
        queue_nmt(NMT_START, 1);
        ticks(10);
        TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
        TEST_ASSERT_NOT_NULL(sent(0x202));
    }
}

static void test_network_leaves_with_the_valves_open(void)
{
    /* GIVEN RUN WHEN the node is reset THEN the next tick begins with one frame that shuts the valves, before
     * boot-up; from STANDBY, where they are shut already, neither a reset nor a stop sends one */
    to_run(CONTROLLER_DIARC);
    queue_nmt(NMT_RESET, 1);
    tick();
    tick();
    TEST_ASSERT_EQUAL_UINT(1, count_sent(0x202));
    TEST_ASSERT_EQUAL_HEX32(0x202, bus.sent[0].id);
    TEST_ASSERT_EQUAL_UINT32(DISABLED, get_bits(bus.sent[0].data, 52, 4));
    TEST_ASSERT_EQUAL_HEX32(0x701, bus.sent[1].id);
    static const uint8_t commands[] = {NMT_RESET, NMT_STOP};
    for (unsigned n = 0; n < COUNT_OF(commands); n++) {
        setUp();
        to_standby();
        queue_nmt(commands[n], 1);
        tick();
        TEST_ASSERT_EQUAL_UINT(commands[n] == NMT_RESET ? 1u : 0u, count_sent(0x202));
        tick();
        TEST_ASSERT_NULL(sent(0x202));
    }
}

static void test_shutdown_leaves_the_valves_open(void)
{
    /* GIVEN RUN with an open valve WHEN the port shuts down THEN one frame, valves zero and disabled */
    to_run(CONTROLLER_PID);
    push(SWING, 0.02);
    TEST_ASSERT_TRUE(spool(SWING) != 0);
    bus.sent_count = 0;
    ecu_shutdown(&ecu, &PORT);
    TEST_ASSERT_EQUAL_UINT(1, bus.sent_count);
    TEST_ASSERT_EQUAL_INT32(0, spool(SWING));
    TEST_ASSERT_EQUAL_UINT32(DISABLED, get_bits(sent(0x202)->data, 48, 4));
}

static void test_controller_drives_the_error_up(void)
{
    /* GIVEN RUN WHEN the arm is pushed ahead of its reference THEN every controller draws it back, each joint
     * its own valve */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        for (uint8_t i = 0; i < JOINTS; i++) {
            setUp();
            to_run(controller);
            ticks(5);
            const enum joint other = i == SWING ? WRIST : SWING;
            const int32_t before = spool(other);
            push((enum joint)i, 5e-3);
            ticks(3);
            TEST_ASSERT_TRUE(spool((enum joint)i) < -100);
            TEST_ASSERT_INT32_WITHIN(50, before, spool(other));
        }
    }
}

static void test_force_of_the_other_joint_fed_back(void)
{
    /* GIVEN RUN with DIARC WHEN one cylinder pushes too hard THEN its own valve lets pressure off, the other
     * stays */
    for (uint8_t i = 0; i < JOINTS; i++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        ticks(5);
        const enum joint other = i == SWING ? WRIST : SWING;
        const int32_t before = spool(other);
        sensors.pressure[i][BORE] = (uint16_t)(sensors.pressure[i][BORE] + 400); /* 2 bar */
        ticks(3);
        TEST_ASSERT_TRUE(spool((enum joint)i) < -100);
        TEST_ASSERT_INT32_WITHIN(50, before, spool(other));
    }
}

static void test_request_refused_for_the_wrong_reason(void)
{
    /* GIVEN every situation in which a request cannot be carried out WHEN it comes THEN its own reason,
     * counted once, and the mode stays */
    tick();
    queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
    expect_refusal(REFUSAL_NOT_OPERATIONAL);
    silence(true);
    queue_nmt(NMT_START, 1);
    queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
    expect_refusal(REFUSAL_NOT_IN_STANDBY); /* INIT */
    silence(false);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    queue_request(REQUEST_MOVE, SWING, 0, 0.3, 500);
    expect_refusal(REFUSAL_NOT_IN_RUN);
    queue_request(REQUEST_RESET_FAULT, 0, 0, 0, 1);
    expect_refusal(REFUSAL_NO_FAULT_TO_RESET);
    queue_request(REQUEST_RUN, 0, 3, 0, 1);
    expect_refusal(REFUSAL_UNKNOWN_REQUEST); /* no such controller */
    for (uint8_t request = REQUESTS; request <= 15u; request++) {
        queue_request(request, 0, 0, 0, 1);
        expect_refusal(REFUSAL_UNKNOWN_REQUEST);
    }
    sensors.silent[2] = true;
    queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
    expect_refusal(REFUSAL_SENSORS_NOT_FRESH);
    sensors.silent[2] = false;

    setUp();
    to_run(CONTROLLER_DIARC);
    queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
    expect_refusal(REFUSAL_NOT_IN_STANDBY);
    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    expect_refusal(REFUSAL_NOT_IN_STANDBY);
    queue_request(REQUEST_MOVE, 2, 0, 0.3, 500);
    expect_refusal(REFUSAL_UNKNOWN_REQUEST); /* no such joint */
    queue_request(REQUEST_MOVE, SWING, 0, 1.21, 500);
    expect_refusal(REFUSAL_TARGET_OUT_OF_RANGE);
    queue_request(REQUEST_MOVE, WRIST, 0, -1.01, 500);
    expect_refusal(REFUSAL_TARGET_OUT_OF_RANGE);
    queue_request(REQUEST_MOVE, WRIST, 0, 0.3, 0);
    expect_refusal(REFUSAL_DURATION_TOO_SHORT);

    setUp();
    to_fault();
    silence(true);
    tick();
    queue_request(REQUEST_RESET_FAULT, 0, 0, 0, 1);
    expect_refusal(REFUSAL_SENSORS_NOT_FRESH);
}

static void test_move_shorter_than_a_tick_accepted(void)
{
    /* GIVEN a tick of 2 ms WHEN a move of 1 ms is asked for THEN refused, of 2 ms THEN done */
    power_on_with_period(2000);
    to_run(CONTROLLER_DIARC);
    queue_request(REQUEST_MOVE, SWING, 0, 0.1001, 1);
    expect_refusal(REFUSAL_DURATION_TOO_SHORT);
    queue_request(REQUEST_MOVE, SWING, 0, 0.1001, 2);
    tick();
    TEST_ASSERT_EQUAL_UINT16(1, ecu.counters.refused);
}

static void test_request_of_nothing_refused(void)
{
    /* GIVEN an empty request, or STANDBY in STANDBY WHEN it comes THEN not counted as refused */
    to_standby();
    queue_request(REQUEST_NONE, 0, 0, 0, 0);
    tick();
    queue_request(REQUEST_STANDBY, 0, 0, 0, 0);
    tick();
    TEST_ASSERT_EQUAL_UINT16(0, ecu.counters.refused);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
}

static void test_move_not_carried_out_as_asked(void)
{
    /* GIVEN RUN WHEN a move is asked for THEN the joint's reference is there after its duration, to the raw
     * unit, the other joint stays, and Moving is true meanwhile; a second one is refused until then */
    for (uint8_t i = 0; i < JOINTS; i++) {
        setUp();
        to_run(CONTROLLER_PID);
        sensors.follow = true;
        queue_request(REQUEST_MOVE, i, 0, 0.15, 200);
        ticks(100);
        TEST_ASSERT_TRUE(trajectory_moving(&ecu.controller.trajectory[i]));
        TEST_ASSERT_FALSE(trajectory_moving(&ecu.controller.trajectory[1 - i]));
        queue_request(REQUEST_MOVE, i, 0, -0.2, 200);
        expect_refusal(REFUSAL_MOVE_UNDER_WAY);
        TEST_ASSERT_EQUAL_UINT32(1, get_bits(wait_for(0x181, 0, 8, -1), 60, 1));
        while (ecu.counters.ticks < 202) { /* started in the third tick */
            TEST_ASSERT_TRUE(trajectory_moving(&ecu.controller.trajectory[i]));
            tick();
        }
        TEST_ASSERT_FALSE(trajectory_moving(&ecu.controller.trajectory[i]));
        TEST_ASSERT_EQUAL_UINT32(0, get_bits(wait_for(0x181, 0, 8, -1), 60, 1));
        TEST_ASSERT_INT32_WITHIN(1, angle_raw(0.15), get_signed(wait_for(0x281, 16, 4, i), 40, 24));
        TEST_ASSERT_INT32_WITHIN(1, angle_raw(0.1), get_signed(wait_for(0x281, 16, 4, 1 - i), 40, 24));
    }
}

static void test_repeated_request_carried_out_twice(void)
{
    /* GIVEN a frame that a gateway repeats WHEN it comes again THEN neither carried out nor counted as a
     * refusal */
    to_standby();
    queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
    const struct can_frame_11bit repeated = bus.waiting[bus.waiting_count - 1];
    tick();
    queue_request(REQUEST_STANDBY, 0, 0, 0, 1);
    ticks(STOP_TICKS);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    /* 15 requests on, the counter is the same again */
    for (int k = 0; k < 13; k++) {
        queue_request(REQUEST_NONE, 0, 0, 0, 0);
    }
    queue(repeated);
    queue(repeated);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    queue(repeated);
    tick();
    TEST_ASSERT_EQUAL_UINT16(0, ecu.counters.refused);
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

/* Pump off: tank pressure of 3 bar and each sensor's own error. */
static void depressurise(int bore_error_raw, int annulus_error_raw)
{
    for (uint8_t i = 0; i < JOINTS; i++) {
        sensors.pressure[i][BORE] = (uint16_t)(600 + bore_error_raw);
        sensors.pressure[i][ANNULUS] = (uint16_t)(600 + annulus_error_raw);
    }
}

static double offset_Pa(enum joint i, enum chamber c)
{
    return si_of(ecu.tare.offset[i][c], ecu.bases.pressure);
}

static void test_tare_finds_another_zero(void)
{
    /* GIVEN sensors that are 0.2 bar high and 0.4 bar low, and noisy WHEN tared THEN for 0.1 s the valves are
     * shut in a mode of its own, then STANDBY, and 0.2 and -0.4 bar are taken off ever after */
    to_standby();
    depressurise(40, -80);
    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    for (int k = 0; k < 100; k++) {
        TEST_ASSERT_EQUAL_INT(k == 0 ? MODE_STANDBY : MODE_TARE, ecu.mode);
        sensors.pressure[WRIST][BORE] = (uint16_t)(640 + (k % 2 == 0 ? 4 : -4));
        tick();
    }
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_EQUAL_UINT16(0, ecu.counters.refused);
    for (uint8_t i = 0; i < JOINTS; i++) {
        TEST_ASSERT_DOUBLE_WITHIN(32, 0.2e5, offset_Pa((enum joint)i, BORE)); /* a sixteenth of a raw step */
        TEST_ASSERT_DOUBLE_WITHIN(32, -0.4e5, offset_Pa((enum joint)i, ANNULUS));
    }
    /* with both sides at tank pressure in truth, the force is that of the areas' difference */
    ticks(ROW_TURNS);
    const double force_N =
        si_of(ecu.controller.estimator.hydraulics[SWING].force, ecu.bases.pressure + ecu.bases.area);
    TEST_ASSERT_DOUBLE_WITHIN(0.1, 3e5 * (8.04247719e-4 - 5.49778714e-4), force_N);
}

static void test_tare_with_the_pump_on(void)
{
    /* GIVEN one chamber more than 5 bar from tank pressure WHEN tared THEN refused, and nothing is taken off;
     * at just 5 bar it is done */
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        setUp();
        to_standby();
        depressurise(0, 0);
        sensors.pressure[n / CHAMBERS][n % CHAMBERS] = 600 + 1002;
        queue_request(REQUEST_TARE, 0, 0, 0, 1);
        ticks(100);
        TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
        TEST_ASSERT_EQUAL_INT(REFUSAL_NOT_DEPRESSURISED, ecu.counters.last_refusal);
        for (uint8_t k = 0; k < JOINTS * CHAMBERS; k++) {
            TEST_ASSERT_TRUE(ecu.tare.offset[k / CHAMBERS][k % CHAMBERS] == SCALAR(0));
        }
        sensors.pressure[n / CHAMBERS][n % CHAMBERS] = 600 + 999;
        queue_request(REQUEST_TARE, 0, 0, 0, 1);
        ticks(100);
        TEST_ASSERT_EQUAL_UINT16(1, ecu.counters.refused);
    }
}

static void test_refused_tare_forgets_the_last_good_one(void)
{
    /* GIVEN a good tare WHEN one with the pump on is refused, or another is broken off THEN the offsets of the
     * good one stay, all of them */
    to_standby();
    depressurise(40, -80);
    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    ticks(100);
    const struct tare good = ecu.tare;
    TEST_ASSERT_DOUBLE_WITHIN(32, 0.2e5, offset_Pa(SWING, BORE));
    sensors.pressure[WRIST][ANNULUS] = 600 + 1002;
    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    ticks(100);
    TEST_ASSERT_EQUAL_INT(REFUSAL_NOT_DEPRESSURISED, ecu.counters.last_refusal);
    TEST_ASSERT_EQUAL_MEMORY(good.offset, ecu.tare.offset, sizeof good.offset);
    depressurise(0, 0);
    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    ticks(50);
    queue_request(REQUEST_STANDBY, 0, 0, 0, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_EQUAL_MEMORY(good.offset, ecu.tare.offset, sizeof good.offset);
}

static void test_tare_cannot_be_left(void)
{
    /* GIVEN a tare under way WHEN STANDBY is asked for, the network is stopped or the sensors are gone THEN
     * it ends; RUN and MOVE are refused meanwhile */
    to_standby();
    depressurise(0, 0);
    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    ticks(10);
    queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
    expect_refusal(REFUSAL_NOT_IN_STANDBY);
    queue_request(REQUEST_MOVE, SWING, 0, 0.3, 500);
    expect_refusal(REFUSAL_NOT_IN_RUN);
    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    expect_refusal(REFUSAL_NOT_IN_STANDBY);
    queue_request(REQUEST_STANDBY, 0, 0, 0, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);

    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    ticks(10);
    queue_nmt(NMT_STOP, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);

    queue_nmt(NMT_START, 1);
    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    ticks(10);
    silence(true);
    ticks(WRONG_TICKS);
    TEST_ASSERT_EQUAL_INT(MODE_TARE, ecu.mode);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_INIT, ecu.mode);
}

static void test_tare_counts_samples_that_did_not_come(void)
{
    /* GIVEN a tare WHEN three ticks' frames are lost THEN it takes three ticks longer and finds the same zero
     * */
    to_standby();
    depressurise(40, 40);
    queue_request(REQUEST_TARE, 0, 0, 0, 1);
    ticks(10);
    silence(true);
    ticks(3);
    silence(false);
    ticks(89);
    TEST_ASSERT_EQUAL_INT(MODE_TARE, ecu.mode);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_DOUBLE_WITHIN(32, 0.2e5, offset_Pa(SWING, BORE));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_valves_commanded_before_the_network_is_started);
    RUN_TEST(test_standby_without_sensors);
    RUN_TEST(test_standby_outlives_the_sensors);
    RUN_TEST(test_run_not_entered_or_valves_not_enabled);
    RUN_TEST(test_arm_jumps_when_armed);
    RUN_TEST(test_standby_request_ignored);
    RUN_TEST(test_load_compensated_where_it_must_not_be);
    RUN_TEST(test_run_wins_over_a_later_standby);
    RUN_TEST(test_run_wins_over_a_network_stop);
    RUN_TEST(test_network_stop_leaves_the_arm_running);
    RUN_TEST(test_network_leaves_with_the_valves_open);
    RUN_TEST(test_shutdown_leaves_the_valves_open);
    RUN_TEST(test_controller_drives_the_error_up);
    RUN_TEST(test_force_of_the_other_joint_fed_back);
    RUN_TEST(test_request_refused_for_the_wrong_reason);
    RUN_TEST(test_move_shorter_than_a_tick_accepted);
    RUN_TEST(test_request_of_nothing_refused);
    RUN_TEST(test_move_not_carried_out_as_asked);
    RUN_TEST(test_repeated_request_carried_out_twice);
    RUN_TEST(test_tare_finds_another_zero);
    RUN_TEST(test_tare_with_the_pump_on);
    RUN_TEST(test_refused_tare_forgets_the_last_good_one);
    RUN_TEST(test_tare_cannot_be_left);
    RUN_TEST(test_tare_counts_samples_that_did_not_come);
    return UNITY_END();
}
