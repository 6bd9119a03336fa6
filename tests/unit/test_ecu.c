/* The whole ECU (ecu/ecu) tick by tick on a port of arrays: modes, requests, faults and the frames it sends.
 * The arm is held still unless a test says otherwise. */
#include "ecu/ecu.h"

#include "can_protocol/generated/diarc.h"
#include "can_protocol/generated/diarc_hash.h"
#include "ecu/transmit.h"
#include "testing.h"

enum { QUEUE = 4096, RAW_PER_TURN = 1 << 24 };

enum { NMT_START = 1, NMT_STOP = 2, NMT_PRE_OP = 128, NMT_RESET = 129, NMT_RESET_COMMUNICATION = 130 };
enum { REQUEST_NONE, REQUEST_STANDBY, REQUEST_RUN, REQUEST_MOVE, REQUEST_RESET_FAULT, REQUEST_TARE };
enum { DISABLED = 1, ACTIVE = 7 };

static struct ecu ecu;

/* The port. */
static struct {
    struct can_frame_11bit sent[QUEUE];
    unsigned sent_count;
    struct can_frame_11bit waiting[QUEUE];
    unsigned waiting_count, waiting_next;
    bool full;       /* no frame is taken */
    uint32_t now_us; /* advanced by step_us with every look at it */
    uint32_t step_us;
} bus;

/* An arm that rests at 0.1 rad with 3 kg: pressures in bar. */
static const double REST_BAR[JOINTS][CHAMBERS] = {{50, 73.14}, {42.06, 50}};

/* What the sensors say. */
static struct {
    int32_t angle[JOINTS];
    uint16_t pressure[JOINTS][CHAMBERS];
    int16_t spool[JOINTS];
    uint8_t status[3]; /* encoders, pressures */
    bool silent[3];
} sensors;

static uint8_t motion_counter;

/* Every valve frame, in every test: outside RUN the valves are zero and disabled. */
static void watch_valves(const struct can_frame_11bit *frame)
{
    const uint8_t *const d = frame->data;
    TEST_ASSERT_EQUAL_UINT8(8, frame->length);
    TEST_ASSERT_TRUE(e2e_intact(0x202, d));
    const bool run = get_bits(d, 12, 4) == MODE_RUN;
    TEST_ASSERT_EQUAL_UINT32(run ? ACTIVE : DISABLED, get_bits(d, 48, 4));
    TEST_ASSERT_EQUAL_UINT32(run ? ACTIVE : DISABLED, get_bits(d, 52, 4));
    TEST_ASSERT_EQUAL_UINT32(ecu.mode, get_bits(d, 12, 4));
    TEST_ASSERT_EQUAL_UINT32(ecu.sync_counter, get_bits(d, 56, 8));
    if (!run) {
        TEST_ASSERT_EQUAL_INT32(0, get_signed(d, 16, 16));
        TEST_ASSERT_EQUAL_INT32(0, get_signed(d, 32, 16));
    }
}

static enum port_status port_send(void *context, const struct can_frame_11bit *frame)
{
    TEST_ASSERT_EQUAL_PTR(&bus, context);
    if (frame->id == 0x202u) {
        watch_valves(frame);
    }
    if (bus.full) {
        return PORT_BUSY;
    }
    TEST_ASSERT_LESS_THAN_UINT(QUEUE, bus.sent_count);
    bus.sent[bus.sent_count++] = *frame;
    return PORT_OK;
}

static enum port_status port_receive(void *context, struct can_frame_11bit *frame)
{
    TEST_ASSERT_EQUAL_PTR(&bus, context);
    if (bus.waiting_next >= bus.waiting_count) {
        bus.waiting_next = bus.waiting_count = 0;
        return PORT_EMPTY;
    }
    *frame = bus.waiting[bus.waiting_next++];
    return PORT_OK;
}

static uint32_t port_now_us(void *context)
{
    TEST_ASSERT_EQUAL_PTR(&bus, context);
    bus.now_us += bus.step_us;
    return bus.now_us;
}

static const struct ecu_port PORT = {
    .context = &bus, .send = port_send, .receive = port_receive, .now_us = port_now_us};

static int32_t angle_raw(double rad)
{
    return (int32_t)lround(rad * RAW_PER_TURN / (2 * PI_REAL));
}

static void power_on_with_period(uint32_t period_us)
{
    uint16_t entry;
    memset(&bus, 0, sizeof bus);
    memset(&sensors, 0, sizeof sensors);
    motion_counter = 0;
    for (uint8_t i = 0; i < JOINTS; i++) {
        sensors.angle[i] = angle_raw(0.1);
        sensors.pressure[i][BORE] = (uint16_t)(REST_BAR[i][BORE] * 200);
        sensors.pressure[i][ANNULUS] = (uint16_t)(REST_BAR[i][ANNULUS] * 200);
    }
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, NULL, period_us, &entry));
}

void setUp(void)
{
    power_on_with_period(1000);
}

void tearDown(void)
{
}

static void queue(struct can_frame_11bit frame)
{
    TEST_ASSERT_LESS_THAN_UINT(QUEUE, bus.waiting_count);
    bus.waiting[bus.waiting_count++] = frame;
}

static void queue_nmt(uint8_t command, uint8_t node)
{
    queue((struct can_frame_11bit){.id = 0, .length = 2, .data = {command, node}});
}

static void queue_request(uint8_t request, uint8_t joint, uint8_t controller, double target_rad,
                          uint16_t duration_ms)
{
    struct can_frame_11bit frame = {.id = 0x201, .length = 8};
    put_bits(frame.data, 16, 4, request);
    put_bits(frame.data, 20, 2, joint);
    put_bits(frame.data, 22, 2, controller);
    put_bits(frame.data, 24, 24, angle_raw(target_rad));
    put_bits(frame.data, 48, 16, duration_ms);
    e2e_protect(0x201, motion_counter, frame.data);
    motion_counter = (uint8_t)((motion_counter + 1u) % E2E_COUNTER_STATES);
    queue(frame);
}

static void queue_sensors(void)
{
    const uint8_t counter = (uint8_t)((ecu.sync_counter - 1u) % E2E_COUNTER_STATES);
    if (!sensors.silent[0]) {
        struct can_frame_11bit frame = {.id = 0x182, .length = 8};
        put_bits(frame.data, 12, 4, sensors.status[0]);
        put_bits(frame.data, 16, 24, sensors.angle[SWING]);
        put_bits(frame.data, 40, 24, sensors.angle[WRIST]);
        e2e_protect(0x182, counter, frame.data);
        queue(frame);
    }
    for (uint8_t i = 0; i < JOINTS; i++) {
        if (!sensors.silent[1 + i]) {
            const uint16_t id = i == SWING ? 0x282 : 0x382;
            struct can_frame_11bit frame = {.id = id, .length = 8};
            put_bits(frame.data, 12, 4, sensors.status[1 + i]);
            put_bits(frame.data, 16, 16, sensors.pressure[i][BORE]);
            put_bits(frame.data, 32, 16, sensors.pressure[i][ANNULUS]);
            put_bits(frame.data, 48, 16, sensors.spool[i]);
            e2e_protect(id, counter, frame.data);
            queue(frame);
        }
    }
}

static void silence(bool silent)
{
    sensors.silent[0] = sensors.silent[1] = sensors.silent[2] = silent;
}

/* One tick; what it sent is bus.sent. Requests queued before it come before its sensor frames. */
static void tick(void)
{
    bus.sent_count = 0;
    ecu_tick_begin(&ecu, &PORT);
    queue_sensors();
    (void)ecu_tick_receive(&ecu, &PORT);
    ecu_tick_end(&ecu, &PORT);
}

static void ticks(unsigned count)
{
    for (unsigned k = 0; k < count; k++) {
        tick();
    }
}

static const struct can_frame_11bit *sent(uint32_t id)
{
    for (unsigned k = 0; k < bus.sent_count; k++) {
        if (bus.sent[k].id == id) {
            return &bus.sent[k];
        }
    }
    return NULL;
}

static unsigned count_sent(uint32_t id)
{
    unsigned count = 0;
    for (unsigned k = 0; k < bus.sent_count; k++) {
        count += bus.sent[k].id == id ? 1u : 0u;
    }
    return count;
}

/* The next frame with this id, within 40 ticks; page: value of its multiplexer at `start`, or -1. */
static const uint8_t *wait_for(uint32_t id, unsigned start, unsigned length, int page)
{
    for (int k = 0; k < 80; k++) {
        tick();
        const struct can_frame_11bit *const frame = sent(id);
        if (frame != NULL && (page < 0 || get_bits(frame->data, start, length) == (uint32_t)page)) {
            TEST_ASSERT_TRUE(e2e_intact((uint16_t)id, frame->data));
            return frame->data;
        }
    }
    TEST_FAIL_MESSAGE("frame not sent");
    return NULL;
}

static const uint8_t *timing_page(int page)
{
    return wait_for(0x481, 16, 8, page);
}

static void to_standby(void)
{
    queue_nmt(NMT_START, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
}

static void to_run(uint8_t controller)
{
    to_standby();
    queue_request(REQUEST_RUN, 0, controller, 0, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

static void to_fault(void)
{
    to_run(CONTROLLER_DIARC);
    silence(true);
    ticks(6);
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    silence(false);
}

static int32_t spool(enum joint i)
{
    const struct can_frame_11bit *const frame = sent(0x202);
    TEST_ASSERT_NOT_NULL(frame);
    return get_signed(frame->data, i == SWING ? 16 : 32, 16);
}

/* ---- frames of a tick ---- */

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

/* ---- modes ---- */

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
    /* GIVEN STANDBY WHEN the sensors fall silent for more than 5 ticks THEN back to INIT, no fault, and to
     * STANDBY again when they come back */
    to_standby();
    silence(true);
    ticks(5);
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
    /* GIVEN RUN with an open valve WHEN STANDBY is asked for THEN valves zero and disabled in that tick's
     * frame, and the next RUN starts afresh, where the arm is now and with the force it has now */
    for (uint8_t controller = 0; controller < CONTROLLERS; controller++) {
        setUp();
        to_run(controller);
        ticks(5);
        sensors.angle[SWING] += angle_raw(0.01);
        ticks(200);
        TEST_ASSERT_TRUE(spool(SWING) < -100);
        queue_request(REQUEST_STANDBY, 0, 0, 0, 1);
        tick();
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
            sensors.angle[i] = angle_raw(0.1 + 1e-4 * lcg_uniform(&noise, -1, 1));
            sensors.pressure[i][BORE] =
                (uint16_t)(200 * REST_BAR[i][BORE] + 100 * lcg_uniform(&noise, -1, 1));
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

static void test_shutdown_leaves_the_valves_open(void)
{
    /* GIVEN RUN with an open valve WHEN the port shuts down THEN one frame, valves zero and disabled */
    to_run(CONTROLLER_PID);
    sensors.angle[SWING] += angle_raw(0.02);
    tick();
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
            sensors.angle[i] += angle_raw(5e-3);
            ticks(5);
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

/* ---- faults ---- */

static void test_fault_too_early_or_never(void)
{
    /* GIVEN RUN WHEN any one sensor frame is missing for exactly 5 ticks THEN nothing; for 6 THEN a fault,
     * valves shut in that very tick, and an emergency before them */
    for (uint8_t n = 0; n < 3u; n++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        for (int round = 0; round < 3; round++) { /* the count starts again with every good tick */
            sensors.silent[n] = true;
            ticks(5);
            sensors.silent[n] = false;
            tick();
            TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
        }
        sensors.silent[n] = true;
        ticks(6);
        TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
        TEST_ASSERT_EQUAL_INT(FAULT_SENSOR_FRAMES_LOST, ecu.fault);
        TEST_ASSERT_EQUAL_HEX32(0x81, bus.sent[1].id);
        TEST_ASSERT_EQUAL_HEX32(0x8100, get_bits(bus.sent[1].data, 0, 16));
        TEST_ASSERT_EQUAL_HEX8(0x81, bus.sent[1].data[2]);
        TEST_ASSERT_EQUAL_UINT8(FAULT_SENSOR_FRAMES_LOST, bus.sent[1].data[3]);
        TEST_ASSERT_EQUAL_UINT32(ecu.counters.ticks - 1u, get_bits(bus.sent[1].data, 32, 32));
        TEST_ASSERT_EQUAL_INT32(0, spool(SWING));
        tick();
        TEST_ASSERT_NULL(sent(0x81)); /* once */
        TEST_ASSERT_EQUAL_UINT32(FAULT_SENSOR_FRAMES_LOST, get_bits(timing_page(0), 56, 8));
    }
}

static void make_invalid(unsigned what)
{
    switch (what) {
    case 0:
        sensors.status[0] = 15;
        break;
    case 1:
        sensors.status[1] = 15;
        break;
    case 2:
        sensors.status[2] = 15;
        break;
    case 3:
        sensors.angle[SWING] = -8388608;
        break;
    case 4:
        sensors.angle[WRIST] = -8388608;
        break;
    case 5:
        sensors.pressure[SWING][BORE] = 65535;
        break;
    case 6:
        sensors.pressure[WRIST][ANNULUS] = 65535;
        break;
    case 7:
        sensors.spool[SWING] = -32768;
        break;
    default:
        sensors.spool[WRIST] = -32768;
        break;
    }
}

static void test_invalid_sensor_value_used(void)
{
    /* GIVEN RUN WHEN a sensor says that it is invalid, in its status or by the reserved value THEN for 5
     * ticks the valves stay calm, and after 6 there is a fault that says so */
    for (unsigned what = 0; what < 9; what++) {
        setUp();
        to_run(CONTROLLER_DIARC);
        ticks(20);
        const int32_t before[JOINTS] = {spool(SWING), spool(WRIST)};
        make_invalid(what);
        for (int k = 0; k < 5; k++) {
            tick();
            TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
            TEST_ASSERT_INT32_WITHIN(50, before[SWING], spool(SWING));
            TEST_ASSERT_INT32_WITHIN(50, before[WRIST], spool(WRIST));
        }
        tick();
        TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
        TEST_ASSERT_EQUAL_INT(FAULT_SENSOR_INVALID, ecu.fault);
        TEST_ASSERT_EQUAL_HEX32(0x5000, get_bits(sent(0x81)->data, 0, 16));
    }
}

static void test_degraded_sensor_taken_for_invalid(void)
{
    /* GIVEN RUN WHEN a sensor calls itself degraded, or is at the last valid value THEN no fault */
    to_run(CONTROLLER_DIARC);
    sensors.status[0] = sensors.status[1] = sensors.status[2] = 1;
    sensors.pressure[SWING][BORE] = 65534;
    sensors.spool[WRIST] = -32767;
    ticks(20);
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

static void test_fault_left_by_itself(void)
{
    /* GIVEN FAULT WHEN the sensors are good again THEN it stays, valves shut, RUN refused; only RESET_FAULT
     * leaves it, to STANDBY */
    to_fault();
    TEST_ASSERT_FALSE(ecu.controller.armed);
    ticks(50);
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    queue_request(REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    TEST_ASSERT_EQUAL_INT(REFUSAL_NOT_IN_STANDBY, ecu.counters.last_refusal);
    queue_request(REQUEST_RESET_FAULT, 0, 0, 0, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_EQUAL_INT(FAULT_NONE, ecu.fault);
    TEST_ASSERT_EQUAL_UINT32(FAULT_NONE, get_bits(timing_page(0), 56, 8));
}

static void test_end_of_a_fault_not_told(void)
{
    /* GIVEN FAULT WHEN it is reset THEN one emergency with code 0, as the DBC promises */
    to_fault();
    tick();
    queue_request(REQUEST_RESET_FAULT, 0, 0, 0, 1);
    tick();
    const struct can_frame_11bit *const emergency = sent(0x81);
    TEST_ASSERT_NOT_NULL(emergency);
    TEST_ASSERT_EQUAL_HEX32(0, get_bits(emergency->data, 0, 16));
    TEST_ASSERT_EQUAL_HEX8(0, emergency->data[2]);
    tick();
    TEST_ASSERT_NULL(sent(0x81));
}

static void test_lost_angle_kicks_the_valve(void)
{
    /* GIVEN a move that is followed exactly WHEN encoder frames are lost in the middle of it THEN the valve
     * frames differ little from those without the loss: the angle is predicted, not held */
    int32_t with[3];
    for (int lost = 0; lost < 2; lost++) {
        setUp();
        to_run(CONTROLLER_PID);
        queue_request(REQUEST_MOVE, SWING, 0, 0.7, 1000);
        for (int k = 0; k < 503; k++) {
            tick();
            sensors.angle[SWING] = angle_raw(real(trajectory_now(&ecu.controller.trajectory[SWING]).q));
            sensors.silent[0] = lost == 1 && k >= 499 && k < 502;
            if (k >= 500) {
                if (lost == 0) {
                    with[k - 500] = spool(SWING);
                } else {
                    TEST_ASSERT_INT32_WITHIN(10, with[k - 500], spool(SWING));
                }
            }
        }
    }
}

/* ---- requests ---- */

static void expect_refusal(enum ecu_refusal reason)
{
    const uint16_t before = ecu.counters.refused;
    const enum ecu_mode mode = ecu.mode;
    tick();
    TEST_ASSERT_EQUAL_UINT16(before + 1, ecu.counters.refused);
    TEST_ASSERT_EQUAL_INT(reason, ecu.counters.last_refusal);
    TEST_ASSERT_EQUAL_INT(mode, ecu.mode);
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
    for (uint8_t request = REQUEST_TARE + 1; request <= 15u; request++) {
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
        queue_request(REQUEST_MOVE, i, 0, 0.35, 200);
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
        TEST_ASSERT_INT32_WITHIN(1, angle_raw(0.35), get_signed(wait_for(0x281, 16, 4, i), 40, 24));
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
    tick();
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

/* ---- tare ---- */

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
    ticks(6);
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

/* ---- a bus in trouble ---- */

static void test_full_send_queue_changes_what_the_ecu_does(void)
{
    /* GIVEN RUN WHEN the queue is full for 50 ticks THEN every frame not taken is counted and nothing is
     * retried or done differently: afterwards all is as if it had not been */
    for (int full = 0; full < 2; full++) {
        static struct can_frame_11bit expected[2];
        setUp();
        to_run(CONTROLLER_DIARC);
        queue_request(REQUEST_MOVE, WRIST, 0, 0.3, 500);
        bus.full = full == 1;
        ticks(50);
        bus.full = false;
        tick();
        TEST_ASSERT_EQUAL_HEX32(0x80, bus.sent[0].id);
        TEST_ASSERT_EQUAL_HEX32(0x202, bus.sent[1].id);
        if (full == 0) {
            memcpy(expected, bus.sent, sizeof expected);
            TEST_ASSERT_EQUAL_UINT16(0, ecu.counters.send_drops);
        } else {
            TEST_ASSERT_EQUAL_HEX8_ARRAY(expected[0].data, bus.sent[0].data, 8);
            TEST_ASSERT_EQUAL_HEX8_ARRAY(expected[1].data, bus.sent[1].data, 8);
            /* 50 SYNC, 50 valve frames, 5 slow ones every 10 ticks */
            TEST_ASSERT_EQUAL_UINT16(50 + 50 + 25, ecu.counters.send_drops);
            TEST_ASSERT_EQUAL_UINT32(125, get_bits(timing_page(2), 48, 16));
        }
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

static void test_late_answers_taken(void)
{
    /* GIVEN RUN WHEN the sensor frames come one tick late, again and again THEN they are refused and it is a
     * fault */
    to_run(CONTROLLER_DIARC);
    for (int k = 0; k < 6; k++) {
        bus.sent_count = 0;
        ecu.sync_counter = ecu.sync_counter == 0 ? 240 : ecu.sync_counter;
        queue_sensors(); /* answers the SYNC before */
        ecu_tick_begin(&ecu, &PORT);
        TEST_ASSERT_FALSE(ecu_tick_receive(&ecu, &PORT));
        ecu_tick_end(&ecu, &PORT);
    }
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    TEST_ASSERT_EQUAL_UINT16(6, ecu.counters.late_ticks);
    TEST_ASSERT_EQUAL_UINT8(18, ecu.receive.refused);
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
    RUN_TEST(test_network_command_for_another_node_obeyed);
    RUN_TEST(test_something_survives_a_reset);
    RUN_TEST(test_shutdown_leaves_the_valves_open);
    RUN_TEST(test_controller_drives_the_error_up);
    RUN_TEST(test_force_of_the_other_joint_fed_back);
    RUN_TEST(test_fault_too_early_or_never);
    RUN_TEST(test_invalid_sensor_value_used);
    RUN_TEST(test_degraded_sensor_taken_for_invalid);
    RUN_TEST(test_fault_left_by_itself);
    RUN_TEST(test_end_of_a_fault_not_told);
    RUN_TEST(test_lost_angle_kicks_the_valve);
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
    RUN_TEST(test_full_send_queue_changes_what_the_ecu_does);
    RUN_TEST(test_flood_of_frames_holds_up_the_tick);
    RUN_TEST(test_late_answers_taken);
    return UNITY_END();
}
