/* The whole ECU (ecu/ecu) tick by tick: the frames it sends and takes, when, and what they carry. */
#include "can_protocol/generated/diarc_hash.h"
#include "ecu/transmit.h"
#include "ecu_bench.h"

void setUp(void)
{
    power_on_with_period(1000);
}

void tearDown(void)
{
}

static void test_tick_begins_with_something_else_than_sync(void)
{
    /* GIVEN an ECU at work WHEN a tick begins THEN SYNC and nothing else goes out; the valve frame only when
     * the sensors have been heard, once, before all others */
    to_run(CONTROLLER_DIARC);
    for (int k = 0; k < 30; k++) {
        bus.sent_count = 0;
        ecu_tick_begin(&ecu, &PORT);
        TEST_ASSERT_EQUAL_UINT(1, bus.sent_count);
        TEST_ASSERT_EQUAL_HEX32(0x80, bus.sent[0].id);
        TEST_ASSERT_EQUAL_UINT8(1, bus.sent[0].length);
        TEST_ASSERT_EQUAL_UINT8(ecu.sync_counter, bus.sent[0].data[0]);
        queue_sensors();
        TEST_ASSERT_TRUE(ecu_tick_receive(&ecu, &PORT));
        TEST_ASSERT_EQUAL_UINT(1, bus.sent_count);
        ecu_tick_end(&ecu, &PORT);
        TEST_ASSERT_EQUAL_HEX32(0x202, bus.sent[1].id);
        TEST_ASSERT_TRUE(bus.sent_count <= 4u); /* at most one slow frame, and a heartbeat */
        for (unsigned n = 2; n < bus.sent_count; n++) {
            TEST_ASSERT_NOT_EQUAL(0x202, bus.sent[n].id);
        }
    }
}

static void test_tick_done_before_its_last_frame(void)
{
    /* GIVEN sensor frames that come one at a time WHEN received THEN the tick is complete with the third */
    to_standby();
    ecu_tick_begin(&ecu, &PORT);
    queue_sensors();
    const unsigned all = bus.waiting_count;
    TEST_ASSERT_EQUAL_UINT(3, all);
    for (unsigned n = 1; n <= all; n++) {
        bus.waiting_count = n;
        const unsigned next = n - 1;
        bus.waiting_next = next;
        struct can_frame_11bit kept[3];
        memcpy(kept, bus.waiting, sizeof kept);
        TEST_ASSERT_EQUAL_INT(n == all, ecu_tick_receive(&ecu, &PORT));
        memcpy(bus.waiting, kept, sizeof kept);
    }
    ecu_tick_end(&ecu, &PORT);
}

static void test_sync_counter_leaves_1_to_240(void)
{
    /* GIVEN an ECU just on WHEN 600 ticks pass THEN SYNC counts 1..240 and again */
    for (unsigned k = 0; k < 600; k++) {
        tick();
        TEST_ASSERT_EQUAL_UINT8(k % 240 + 1, sent(0x80)->data[0]);
    }
}

static void test_counters_of_the_frames_do_not_follow(void)
{
    /* GIVEN an ECU at work WHEN its frames are followed THEN the counters of each kind run 0..14 without a
     * gap */
    static const uint32_t ids[] = {0x202, 0x181, 0x281, 0x381, 0x481};
    unsigned seen[COUNT_OF(ids)] = {0};
    queue_nmt(NMT_START, 0);
    for (int k = 0; k < 400; k++) {
        tick();
        for (unsigned n = 0; n < COUNT_OF(ids); n++) {
            const struct can_frame_11bit *const frame = sent(ids[n]);
            if (frame != NULL) {
                TEST_ASSERT_TRUE(e2e_intact((uint16_t)ids[n], frame->data));
                TEST_ASSERT_EQUAL_UINT8(seen[n] % 15, e2e_counter(frame->data));
                seen[n]++;
            }
        }
    }
    TEST_ASSERT_EQUAL_UINT(400, seen[0]);
    TEST_ASSERT_EQUAL_UINT(40, seen[1]);
    TEST_ASSERT_EQUAL_UINT(80, seen[2]); /* one joint every 5 ticks */
    TEST_ASSERT_EQUAL_UINT(40, seen[3]);
    TEST_ASSERT_EQUAL_UINT(40, seen[4]);
}

static void test_boot_up_or_heartbeat_missing(void)
{
    /* GIVEN periods of 1 and 2 ms WHEN the ECU is switched on THEN boot-up once, first of all, then a
     * heartbeat with the NMT state every 100 ms */
    static const uint32_t periods_us[] = {1000, 2000};
    for (unsigned n = 0; n < COUNT_OF(periods_us); n++) {
        power_on_with_period(periods_us[n]);
        tick();
        TEST_ASSERT_EQUAL_HEX32(0x701, bus.sent[0].id);
        TEST_ASSERT_EQUAL_UINT8(1, bus.sent[0].length);
        TEST_ASSERT_EQUAL_HEX8(0, bus.sent[0].data[0]);
        TEST_ASSERT_EQUAL_HEX32(0x80, bus.sent[1].id);
        const unsigned in_100_ms = 100000 / periods_us[n];
        unsigned since = 0;
        unsigned beats = 0;
        for (unsigned k = 0; k < 5 * in_100_ms; k++) {
            if (k == 2 * in_100_ms) {
                queue_nmt(NMT_START, 1);
            }
            tick();
            since++;
            const struct can_frame_11bit *const beat = sent(0x701);
            if (beat != NULL) {
                TEST_ASSERT_TRUE(beats == 0 || since == in_100_ms);
                TEST_ASSERT_EQUAL_UINT8(k < 2 * in_100_ms ? 127 : 5, beat->data[0]);
                since = 0;
                beats++;
            }
        }
        TEST_ASSERT_EQUAL_UINT(5, beats);
    }
}

static void test_wrong_dbc_not_noticed(void)
{
    /* GIVEN the timing frame WHEN its page 1 comes THEN the hash of the DBC this firmware was built from */
    to_standby();
    TEST_ASSERT_EQUAL_HEX32(DIARC_DBC_HASH, get_bits(timing_page(1), 24, 32));
}

static void test_timing_pages_wrong(void)
{
    /* GIVEN a late tick, a lost frame, a corrupted one and a refusal WHEN the pages come THEN each is counted
     * */
    to_standby();
    sensors.silent[1] = true;
    tick();
    sensors.silent[1] = false;
    struct can_frame_11bit bad = protected_frame(0x182, 0);
    bad.data[4] ^= 1u;
    queue(bad);
    queue_request(REQUEST_MOVE, 0, 0, 0.2, 500);
    tick();
    const uint8_t *page = timing_page(0);
    TEST_ASSERT_EQUAL_UINT32(1, get_bits(page, 40, 16));
    TEST_ASSERT_EQUAL_UINT32(FAULT_NONE, get_bits(page, 56, 8));
    page = timing_page(2);
    TEST_ASSERT_EQUAL_UINT32(1, get_bits(page, 24, 16));
    TEST_ASSERT_EQUAL_UINT32(1, get_bits(page, 40, 8));
    TEST_ASSERT_EQUAL_UINT32(0, get_bits(page, 48, 16));
    page = timing_page(3);
    TEST_ASSERT_EQUAL_UINT32(1, get_bits(page, 24, 16));
    TEST_ASSERT_EQUAL_UINT32(REFUSAL_NOT_IN_RUN, get_bits(page, 40, 8));
    TEST_ASSERT_EQUAL_UINT32(1000, get_bits(page, 48, 16));
}

static void test_tick_time_wrong_when_the_clock_wraps(void)
{
    /* GIVEN a clock about to wrap WHEN 230 us pass from the last sensor frame to the valve frame THEN 230 */
    to_standby();
    bus.now_us = UINT32_MAX - 100u;
    bus.step_us = 230;
    for (int k = 0; k < 3; k++) {
        tick();
        TEST_ASSERT_EQUAL_UINT16(230, ecu.counters.tick_time_us);
    }
    bus.step_us = 100000;
    tick();
    TEST_ASSERT_EQUAL_UINT16(65535, ecu.counters.tick_time_us);
}

static void test_estimate_or_tracking_frame_wrong(void)
{
    /* GIVEN an arm at rest at 0.1 rad WHEN the frames come THEN prior load and deviation, references in raw
     * units, and a tracking error with its sign */
    to_run(CONTROLLER_DIARC);
    const uint8_t *frame = wait_for(0x181, 0, 8, -1);
    TEST_ASSERT_EQUAL_INT32((int32_t)lround(default_value("estimator.prior.m_t_kg.value") * 1e4),
                            get_signed(frame, 16, 24));
    TEST_ASSERT_EQUAL_UINT32((uint32_t)lround(default_value("estimator.prior.m_t_kg.sd") * 1e3),
                             get_bits(frame, 40, 16));
    TEST_ASSERT_EQUAL_UINT32(0, get_bits(frame, 56, 1)); /* not updating */
    TEST_ASSERT_EQUAL_UINT32(1, get_bits(frame, 57, 1)); /* load used */
    TEST_ASSERT_EQUAL_UINT32(0, get_bits(frame, 60, 1)); /* not moving */
    for (int joint = SWING; joint <= WRIST; joint++) {
        sensors.angle[joint] += joint == SWING ? angle_raw(1e-4) : -angle_raw(1e-4);
        frame = wait_for(0x281, 16, 4, joint);
        TEST_ASSERT_INT32_WITHIN(1, joint == SWING ? 100 : -100, get_signed(frame, 20, 20));
        TEST_ASSERT_INT32_WITHIN(1, angle_raw(0.1), get_signed(frame, 40, 24));
    }
}

/* What one step of fixed point is in raw steps of a signal, rounded up; 0 for the others, which have more digits. */
static int32_t raw_steps(int base_log2, double raw_step)
{
    return (int32_t)ceil(BY_TYPE(0, 0, 1) * ldexp(STEP, base_log2) / raw_step);
}

static void test_parameter_frame_of_another_unit(void)
{
    /* GIVEN an estimator at its priors WHEN all 14 parameter frames have come THEN the priors of the image,
     * in the DBC's units */
    static const struct {
        const char *name;
        double step, sd_step;
    } theta[THETA_M + THETA_H] = {
        {"m_t_kg", 1e-4, 1e-3},
        {"J_kgm2", 1e-5, 1e-5},
        {"m2_kg", 1e-4, 1e-4},
        {"fv_swing_Nms_rad", 1e-3, 1e-3},
        {"fv_wrist_Nms_rad", 1e-3, 1e-3},
        {"fc_swing_Nm", 1e-3, 1e-3},
        {"fc_wrist_Nm", 1e-3, 1e-3},
        {"Om1_swing_Nm", 1e-3, 1e-3},
        {"Om1_wrist_Nm", 1e-3, 1e-3},
        {"beta_inverse_1_Pa", 1e-15, 1e-14},
        {"Om2_swing_m3_s", 1e-10, 1e-10},
        {"Om3_swing_m3_s", 1e-10, 1e-10},
        {"Om2_wrist_m3_s", 1e-10, 1e-10},
        {"Om3_wrist_m3_s", 1e-10, 1e-10},
    };
    to_standby();
    for (int n = 0; n < THETA_M + THETA_H; n++) {
        const uint8_t *const frame = wait_for(0x381, 16, 8, -1);
        const unsigned k = get_bits(frame, 16, 8);
        TEST_ASSERT_EQUAL_UINT(n, k);
        char name[80];
        (void)snprintf(name, sizeof name, "estimator.prior.%s.value", theta[k].name);
        const int base = k < THETA_M    ? base_torque(&ecu.bases)
                         : k == THETA_M ? -ecu.bases.pressure
                                        : base_volume(&ecu.bases);
        TEST_ASSERT_INT32_WITHIN_MESSAGE(1 + raw_steps(base, theta[k].step),
                                         (int32_t)lround(default_value(name) / theta[k].step),
                                         get_signed(frame, 24, 24), name);
        (void)snprintf(name, sizeof name, "estimator.prior.%s.sd", theta[k].name);
        const double sd = default_value(name) / theta[k].sd_step;
        TEST_ASSERT_INT32_WITHIN_MESSAGE(1 + raw_steps(base, theta[k].sd_step),
                                         (int32_t)lround(fmin(sd, 65535)), (int32_t)get_bits(frame, 48, 16),
                                         name);
    }
}

static void test_parameter_frame_wrong_on_a_large_machine(void)
{
    /* GIVEN the largest torque base that an image may have, 2^14 WHEN its inertia J is sent THEN J, in 1e-5
     * kg m^2 */
    struct parameter_image image = default_parameter_image;
    uint16_t entry;
    image.bytes[8] = 22;
    image.bytes[9] = (uint8_t)-6;
    image.bytes[10] = (uint8_t)-2;
    image_seal(&image);
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, &image, 1000, &entry));
    ecu.next_parameter = J;
    const struct can_frame_11bit frame = transmit_parameter(&ecu);
    const double J_kgm2 = default_value("estimator.prior.J_kgm2.value");
    TEST_ASSERT_EQUAL_INT(BASE_TORQUE_HIGH, base_torque(&ecu.bases));
    TEST_ASSERT_INT32_WITHIN(1 + raw_steps(BASE_TORQUE_HIGH, 1e-5), (int32_t)lround(J_kgm2 * 1e5),
                             get_signed(frame.data, 24, 24));
}

static void test_network_command_for_another_node_obeyed(void)
{
    /* GIVEN NMT frames for node 2, of the wrong length or unknown WHEN they come THEN nothing; to all, obeyed
     * */
    queue_nmt(NMT_START, 2);
    queue((struct can_frame_11bit){.id = 0, .length = 1, .data = {NMT_START, 1}});
    queue((struct can_frame_11bit){.id = 0, .length = 8, .data = {NMT_START, 1}});
    queue_nmt(77, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(NMT_PRE_OPERATIONAL, ecu.nmt);
    queue_nmt(NMT_START, 0);
    tick();
    TEST_ASSERT_EQUAL_INT(NMT_OPERATIONAL, ecu.nmt);
}

/* A fixed story of requests and sensor values, all its frames into a log. */
static unsigned story(struct can_frame_11bit *log)
{
    unsigned count = 0;
    struct lcg noise = {5};
    motion_counter = 0;
    for (int k = 0; k < 500; k++) {
        if (k == 2) {
            queue_nmt(NMT_START, 1);
        }
        if (k == 10) {
            queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
        }
        if (k == 20) {
            queue_request(REQUEST_MOVE, WRIST, 0, 0.3, 300);
        }
        sensors.silent[k % 3] = k % 37 == 0;
        for (uint8_t i = 0; i < JOINTS; i++) {
            const struct trajectory *const reference = &ecu.controller.trajectory[i];
            const double q = k > 20 ? real(trajectory_now(reference).q) : 0.1;
            sensors.angle[i] = angle_raw(q + 1e-4 * lcg_uniform(&noise, -1, 1));
            for (uint8_t c = 0; c < CHAMBERS; c++) {
                sensors.pressure[i][c] = pressure_raw((double)REST_PRESSURE[i][c] / RAW_PER_BAR +
                                                      0.5 * lcg_uniform(&noise, -1, 1));
            }
            sensors.spool[i] = (int16_t)(300 * lcg_uniform(&noise, -1, 1));
        }
        tick();
        silence(false);
        for (unsigned n = 0; n < bus.sent_count; n++) {
            TEST_ASSERT_LESS_THAN_UINT(QUEUE, count);
            log[count++] = bus.sent[n];
        }
    }
    return count;
}

static void test_something_survives_a_reset(void)
{
    /* GIVEN a story of requests, moves and lost frames that ends in RUN WHEN the node is reset by NMT and the
     * story is told again THEN one frame shuts the valves, and then every frame is the same, bit for bit, boot-up
     * and SYNC 1 first */
    static struct can_frame_11bit first[QUEUE];
    static struct can_frame_11bit again[QUEUE];
    static const uint8_t resets[] = {NMT_RESET, NMT_RESET_COMMUNICATION};
    const unsigned count = story(first);
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    for (unsigned n = 0; n < COUNT_OF(resets); n++) {
        queue_nmt(resets[n], 1);
        tick();
        memset(again, 0, sizeof again);
        TEST_ASSERT_EQUAL_UINT(count + 1, story(again));
        TEST_ASSERT_EQUAL_HEX32(0x202, again[0].id);
        TEST_ASSERT_EQUAL_UINT32(MODE_STANDBY,
                                 get_bits(again[0].data, 12, 4)); /* watch_valves does the rest */
        TEST_ASSERT_EQUAL_HEX32(0x701, again[1].id);
        TEST_ASSERT_EQUAL_UINT8(1, again[2].data[0]);
        for (unsigned k = 0; k < count; k++) {
            TEST_ASSERT_EQUAL_HEX32(first[k].id, again[k + 1].id);
            TEST_ASSERT_EQUAL_HEX8_ARRAY(first[k].data, again[k + 1].data, 8);
        }
    }
}

static void test_full_send_queue_changes_what_the_ecu_does(void)
{
    /* GIVEN RUN WHEN the queue is full for as long as it may be, 5 ticks, ten times over THEN every frame not taken is
     * counted and nothing is retried or done differently: afterwards all is as if it had not been */
    for (int full = 0; full < 2; full++) {
        static struct can_frame_11bit expected[2];
        setUp();
        to_run(CONTROLLER_DIARC);
        sensors.follow = true;
        queue_request(REQUEST_MOVE, WRIST, 0, 0.3, 500);
        for (int k = 0; k < 60; k++) {
            bus.full = full == 1 && k % 6 != 5;
            tick();
        }
        TEST_ASSERT_EQUAL_HEX32(0x80, bus.sent[0].id);
        TEST_ASSERT_EQUAL_HEX32(0x202, bus.sent[1].id);
        if (full == 0) {
            memcpy(expected, bus.sent, sizeof expected);
            TEST_ASSERT_EQUAL_UINT16(0, ecu.counters.send_drops);
        } else {
            TEST_ASSERT_EQUAL_HEX8_ARRAY(expected[0].data, bus.sent[0].data, 8);
            TEST_ASSERT_EQUAL_HEX8_ARRAY(expected[1].data, bus.sent[1].data, 8);
            /* 50 SYNC, 50 valve frames; of 30 slow ones (5 every 10 ticks) those that fell into a free tick went out */
            const unsigned slow_phases[] = {1, 3, 5, 7, 8};
            unsigned slow = 0;
            for (unsigned k = 0; k < 60; k++) {
                for (unsigned n = 0; n < COUNT_OF(slow_phases); n++) {
                    slow += (k + 2) % 10 == slow_phases[n] && k % 6 != 5 ? 1u : 0u; /* 2 ticks to RUN */
                }
            }
            TEST_ASSERT_EQUAL_UINT16(50 + 50 + slow, ecu.counters.send_drops);
            TEST_ASSERT_EQUAL_UINT32(100 + slow, get_bits(timing_page(2), 48, 16));
        }
        TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
    }
}

static void test_flood_of_frames_holds_up_the_tick(void)
{
    /* GIVEN a bus full of strange frames WHEN received THEN at most 255 a call, so that the tick ends in time
     * */
    to_standby();
    ecu_tick_begin(&ecu, &PORT);
    for (int k = 0; k < 1000; k++) {
        queue(protected_frame(0x555, 0));
    }
    TEST_ASSERT_FALSE(ecu_tick_receive(&ecu, &PORT));
    TEST_ASSERT_EQUAL_UINT(255, bus.waiting_next);
    queue_sensors();
    while (bus.waiting_next > 0u && !ecu_tick_receive(&ecu, &PORT)) {
    }
    ecu_tick_end(&ecu, &PORT);
    TEST_ASSERT_EQUAL_UINT16(0, ecu.counters.late_ticks);
    TEST_ASSERT_EQUAL_UINT8(0, ecu.receive.refused);
}

static void test_friction_of_the_cylinder_taken_for_the_joints(void)
{
    /* GIVEN a machine whose friction acts at the cylinder, and one where it acts at the joint WHEN the arm is away from 0
     * THEN the estimator's lever of friction is the cylinder's lever arm over that at 0, or 1 */
    for (int at_cylinder = 0; at_cylinder < 2; at_cylinder++) {
        struct parameter_image image = default_parameter_image;
        image_set(&image, "arm.friction_at_cylinder", at_cylinder);
        power_on(&image, 1000);
        sensors.angle[SWING] = angle_raw(0.8);
        sensors.angle[WRIST] = angle_raw(-0.7);
        to_standby();
        ticks(2 * ROW_TURNS);
        for (uint8_t i = 0; i < JOINTS; i++) {
            const struct cylinder *const cylinder = &ecu.machine.cylinder[i];
            const struct cylinder_constants *const constants = &ecu.constants.cylinder[i];
            const double R0 = real(cylinder_at(cylinder, constants, SCALAR(0)).R);
            const scalar q = i == SWING ? SCALAR(0.8) : SCALAR(-0.7);
            const double expected = at_cylinder == 1 ? real(cylinder_at(cylinder, constants, q).R) / R0 : 1;
            TEST_ASSERT_TRUE(at_cylinder == 0 || fabs(expected - 1) > 0.05);
            TEST_ASSERT_DOUBLE_WITHIN(1e-5, expected, real(ecu.controller.estimator.mechanics[i].lever));
        }
    }
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_tick_begins_with_something_else_than_sync);
    RUN_TEST(test_tick_done_before_its_last_frame);
    RUN_TEST(test_sync_counter_leaves_1_to_240);
    RUN_TEST(test_counters_of_the_frames_do_not_follow);
    RUN_TEST(test_boot_up_or_heartbeat_missing);
    RUN_TEST(test_wrong_dbc_not_noticed);
    RUN_TEST(test_timing_pages_wrong);
    RUN_TEST(test_tick_time_wrong_when_the_clock_wraps);
    RUN_TEST(test_estimate_or_tracking_frame_wrong);
    RUN_TEST(test_parameter_frame_of_another_unit);
    RUN_TEST(test_parameter_frame_wrong_on_a_large_machine);
    RUN_TEST(test_network_command_for_another_node_obeyed);
    RUN_TEST(test_something_survives_a_reset);
    RUN_TEST(test_full_send_queue_changes_what_the_ecu_does);
    RUN_TEST(test_flood_of_frames_holds_up_the_tick);
    RUN_TEST(test_friction_of_the_cylinder_taken_for_the_joints);
    return UNITY_END();
}
