/* A bench for the whole ECU (ecu/ecu): a port of arrays, sensors that answer SYNC, requests, one tick at a time. The
 * arm is held still unless a test says otherwise. What every valve frame must obey is checked in every test. */
#ifndef ECU_BENCH_H
#define ECU_BENCH_H

#include "can_protocol/generated/diarc.h"
#include "ecu/ecu.h"
#include "testing.h"

enum { QUEUE = 4096, RAW_PER_TURN = 1 << 24, RAW_PER_BAR = 200 };

enum { NMT_START = 1, NMT_STOP = 2, NMT_PRE_OP = 128, NMT_RESET = 129, NMT_RESET_COMMUNICATION = 130 };
enum {
    REQUEST_NONE,
    REQUEST_STANDBY,
    REQUEST_RUN,
    REQUEST_MOVE,
    REQUEST_RESET_FAULT,
    REQUEST_TARE,
    REQUEST_HOLD,
    REQUEST_COMMISSION,
    REQUEST_SAFE_STOP,
    REQUESTS
};
enum { DISABLED = 1, ACTIVE = 7 };

/* Of the built-in machine, arms/reference.toml [supervision], at 1 kHz. */
enum { WRONG_TICKS = 4, STOP_TICKS = 200, SECOND_TICKS = 1000, OUTSIDE_TICKS = 3 };

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

/* What the sensors say. */
static struct {
    int32_t angle[JOINTS];
    uint16_t pressure[JOINTS][CHAMBERS];
    int16_t spool[JOINTS];
    uint8_t status[3]; /* encoders, pressures */
    bool silent[3];
    bool follow; /* the arm is where its reference is, the spools pass what that takes, pressures are noisy */
    double lag_s;                                               /* it does so this much later */
    bool stuck_angle[JOINTS], stuck_pressure[JOINTS][CHAMBERS]; /* while it follows */
} sensors;

/* An arm that is held still, and spools that stay where they are, contradict the valves: only tests that say that their
 * sensors agree have the ECU look at that. Holds from the next power_on on. */
static bool sensors_agree;

static uint8_t motion_counter;

/* Written down again, not the firmware's own: the modes whose valve frames may open a valve. */
static inline bool opens_valves(unsigned mode)
{
    return mode == MODE_RUN || mode == MODE_COMMISSION || mode == MODE_HOLD || mode == MODE_SAFE_STOP;
}

/* Every valve frame, in every test: outside the driving modes the valves are zero and disabled. */
static inline void watch_valves(const struct can_frame_11bit *frame)
{
    const uint8_t *const d = frame->data;
    TEST_ASSERT_EQUAL_UINT8(8, frame->length);
    TEST_ASSERT_TRUE(e2e_intact(0x202, d));
    const bool open = opens_valves(get_bits(d, 12, 4));
    TEST_ASSERT_EQUAL_UINT32(open ? ACTIVE : DISABLED, get_bits(d, 48, 4));
    TEST_ASSERT_EQUAL_UINT32(open ? ACTIVE : DISABLED, get_bits(d, 52, 4));
    TEST_ASSERT_EQUAL_UINT32(ecu.mode, get_bits(d, 12, 4));
    TEST_ASSERT_EQUAL_UINT32(ecu.sync_counter, get_bits(d, 56, 8));
    if (!open) {
        TEST_ASSERT_EQUAL_INT32(0, get_signed(d, 16, 16));
        TEST_ASSERT_EQUAL_INT32(0, get_signed(d, 32, 16));
    }
}

static inline enum port_status port_send(void *context, const struct can_frame_11bit *frame)
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

static inline enum port_status port_receive(void *context, struct can_frame_11bit *frame)
{
    TEST_ASSERT_EQUAL_PTR(&bus, context);
    if (bus.waiting_next >= bus.waiting_count) {
        bus.waiting_next = bus.waiting_count = 0;
        return PORT_EMPTY;
    }
    *frame = bus.waiting[bus.waiting_next++];
    return PORT_OK;
}

static inline uint32_t port_now_us(void *context)
{
    TEST_ASSERT_EQUAL_PTR(&bus, context);
    bus.now_us += bus.step_us;
    return bus.now_us;
}

static const struct ecu_port PORT = {
    .context = &bus, .send = port_send, .receive = port_receive, .now_us = port_now_us};

static inline int32_t angle_raw(double rad)
{
    return (int32_t)lround(rad * RAW_PER_TURN / (2 * PI_REAL));
}

static inline uint16_t pressure_raw(double bar)
{
    return (uint16_t)lround(bar * RAW_PER_BAR);
}

static inline void power_on(const struct parameter_image *image, uint32_t period_us)
{
    uint16_t entry;
    memset(&bus, 0, sizeof bus);
    memset(&sensors, 0, sizeof sensors);
    motion_counter = 0;
    for (uint8_t i = 0; i < JOINTS; i++) {
        sensors.angle[i] = angle_raw(0.1);
        memcpy(sensors.pressure[i], REST_PRESSURE[i], sizeof sensors.pressure[i]);
    }
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, image, period_us, &entry));
    if (!sensors_agree) {
        ecu.machine.limits.contradiction = SCALAR(30);
        ecu.machine.limits.spool_error = SCALAR(4);
    }
}

static inline void power_on_with_period(uint32_t period_us)
{
    power_on(NULL, period_us);
}

/* One parameter of an image, SI; its CRC is made right again. */
static inline void image_set(struct parameter_image *image, const char *name, double value)
{
    const float single = (float)value;
    uint32_t bits;
    memcpy(&bits, &single, sizeof bits);
    image_set_u32(image, IMAGE_HEADER_BYTES + 4u * entry_named(name), bits);
    image_seal(image);
}

static inline void queue(struct can_frame_11bit frame)
{
    TEST_ASSERT_LESS_THAN_UINT(QUEUE, bus.waiting_count);
    bus.waiting[bus.waiting_count++] = frame;
}

static inline void queue_nmt(uint8_t command, uint8_t node)
{
    queue(nmt_frame(command, node));
}

static inline void queue_request(uint8_t request, uint8_t joint, uint8_t controller, double target_rad,
                                 uint16_t duration_ms)
{
    queue(motion_frame(request, joint, controller, angle_raw(target_rad), duration_ms, motion_counter));
    motion_counter = (uint8_t)((motion_counter + 1u) % E2E_COUNTER_STATES);
}

/* A request without joint, target and duration. */
static inline void ask(uint8_t request)
{
    queue_request(request, 0, CONTROLLER_DIARC, 0, 1);
}

static inline void queue_sensors(void)
{
    const uint8_t counter = (uint8_t)((ecu.sync_counter - 1u) % E2E_COUNTER_STATES);
    if (!sensors.silent[0]) {
        queue(encoders_frame(sensors.angle[SWING], sensors.angle[WRIST], sensors.status[0], counter));
    }
    for (uint8_t i = 0; i < JOINTS; i++) {
        if (!sensors.silent[1 + i]) {
            queue(pressures_frame(i, sensors.pressure[i], sensors.spool[i], sensors.status[1 + i], counter));
        }
    }
}

static inline void silence(bool silent)
{
    sensors.silent[0] = sensors.silent[1] = sensors.silent[2] = silent;
}

/* Raw spool that passes the flow of joint i at rate w, when its force does not change: Eq 6. */
static inline int16_t steady_spool(enum joint i, scalar q, scalar w)
{
    const struct cylinder *const cylinder = &ecu.machine.cylinder[i];
    const struct cylinder_state state = cylinder_at(cylinder, &ecu.constants.cylinder[i], q);
    scalar p[CHAMBERS];
    for (uint8_t c = 0; c < CHAMBERS; c++) {
        p[c] = per_unit(sensors.pressure[i][c] * (1e5 / RAW_PER_BAR), ecu.bases.pressure);
    }
    const scalar QL = mul(state.lamA, mul(state.R, w)) + cylinder_leakage(cylinder, &state, p);
    const scalar gain_QL = valve_gain(cylinder, &ecu.machine.supply, &state, p, QL >= SCALAR(0));
    return (int16_t)lround(real(valve_spool(cylinder, quot(QL, gain_QL))) * 16384);
}

/* Raw bore pressure with which joint i carries 3 kg along this reference, Eq 1; the annulus' stays as it is. */
static inline uint16_t carrying_pressure(enum joint i, const struct reference now[JOINTS])
{
    const struct arm *const arm = &ecu.machine.arm;
    const scalar w[JOINTS] = {now[SWING].w, now[WRIST].w};
    const scalar a[JOINTS] = {now[SWING].a, now[WRIST].a};
    const struct wrist_trig trig = wrist_trig(arm, now[WRIST].q);
    struct arm_row row;
    arm_inverse_dynamics(arm, &trig, i, w, a, coulomb_sign(arm, w[i]), SCALAR(1), &row);
    scalar theta[THETA_M];
    for (uint8_t k = 0; k < THETA_M; k++) {
        theta[k] = ecu.machine.estimator.m[k].value;
    }
    theta[M_T] = per_unit(3, base_torque(&ecu.bases));
    const struct cylinder_constants *const cylinder = &ecu.constants.cylinder[i];
    const struct cylinder_state state = cylinder_at(&ecu.machine.cylinder[i], cylinder, now[i].q);
    const double force = real(arm_row_torque(&row, i, theta)) / real(state.R);
    const double annulus_Pa = sensors.pressure[i][ANNULUS] * (1e5 / RAW_PER_BAR);
    const double annulus = ldexp(annulus_Pa, -ecu.bases.pressure) * real(cylinder->area[ANNULUS]);
    const double bore_Pa = ldexp((force + annulus) / real(cylinder->area[BORE]), ecu.bases.pressure);
    return pressure_raw(bore_Pa / 1e5);
}

static inline void follow_reference(void)
{
    struct reference now[JOINTS];
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct reference exact = trajectory_now(&ecu.controller.trajectory[i]);
        now[i] = exact;
        now[i].q = from_real(real(exact.q) - sensors.lag_s * real(exact.w));
        now[i].w = from_real(real(exact.w) - sensors.lag_s * real(exact.a));
    }
    for (uint8_t i = 0; i < JOINTS; i++) {
        if (ecu.controller.armed) {
            if (!sensors.stuck_pressure[i][BORE]) {
                sensors.pressure[i][BORE] = carrying_pressure((enum joint)i, now);
            }
            sensors.spool[i] = steady_spool((enum joint)i, now[i].q, now[i].w);
            if (!sensors.stuck_angle[i]) {
                sensors.angle[i] = angle_raw(real(now[i].q));
            }
        }
        for (uint8_t c = 0; c < CHAMBERS; c++) {
            const unsigned noise = sensors.stuck_pressure[i][c] ? 0u : ecu.counters.ticks % 2u;
            sensors.pressure[i][c] = (uint16_t)(sensors.pressure[i][c] ^ noise);
        }
    }
}

/* One tick; what it sent is bus.sent. Requests queued before it come before its sensor frames. */
static inline void tick(void)
{
    bus.sent_count = 0;
    ecu_tick_begin(&ecu, &PORT);
    queue_sensors();
    (void)ecu_tick_receive(&ecu, &PORT);
    ecu_tick_end(&ecu, &PORT);
    if (sensors.follow) {
        follow_reference();
    }
}

static inline void ticks(unsigned count)
{
    for (unsigned k = 0; k < count; k++) {
        tick();
    }
}

static inline const struct can_frame_11bit *sent(uint32_t id)
{
    for (unsigned k = 0; k < bus.sent_count; k++) {
        if (bus.sent[k].id == id) {
            return &bus.sent[k];
        }
    }
    return NULL;
}

static inline unsigned count_sent(uint32_t id)
{
    unsigned count = 0;
    for (unsigned k = 0; k < bus.sent_count; k++) {
        count += bus.sent[k].id == id ? 1u : 0u;
    }
    return count;
}

/* The next frame with this id, within 80 ticks; page: value of its multiplexer at `start`, or -1. */
static inline const uint8_t *wait_for(uint32_t id, unsigned start, unsigned length, int page)
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

static inline const uint8_t *timing_page(int page)
{
    return wait_for(0x481, 16, 8, page);
}

static inline void to_standby(void)
{
    queue_nmt(NMT_START, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
}

static inline void to_run(uint8_t controller)
{
    to_standby();
    queue_request(REQUEST_RUN, 0, controller, 0, 1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

/* From a driving mode: the sensors fall silent, SAFE_STOP, FAULT; then they are back. */
static inline void sensors_fail(void)
{
    silence(true);
    ticks(WRONG_TICKS + 1);
    TEST_ASSERT_EQUAL_INT(MODE_SAFE_STOP, ecu.mode);
    ticks(STOP_TICKS);
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
    silence(false);
}

static inline void to_fault(void)
{
    to_run(CONTROLLER_DIARC);
    sensors_fail();
}

static inline int32_t spool(enum joint i)
{
    const struct can_frame_11bit *const frame = sent(0x202);
    TEST_ASSERT_NOT_NULL(frame);
    return get_signed(frame->data, i == SWING ? 16 : 32, 16);
}

/* The encoder moves by so much, no faster than an arm can: 0.002 rad a tick. */
static inline void push(enum joint i, double rad)
{
    const int32_t most = angle_raw(0.002);
    int32_t left = angle_raw(rad);
    while (left != 0) {
        const int32_t step = left > most ? most : (left < -most ? -most : left);
        sensors.angle[i] += step;
        left -= step;
        tick();
    }
}

/* The next tick refuses what has been queued, for this reason, and stays in its mode. */
static inline void expect_refusal(enum ecu_refusal reason)
{
    const uint16_t before = ecu.counters.refused;
    const enum ecu_mode mode = ecu.mode;
    tick();
    TEST_ASSERT_EQUAL_UINT16(before + 1, ecu.counters.refused);
    TEST_ASSERT_EQUAL_INT(reason, ecu.counters.last_refusal);
    TEST_ASSERT_EQUAL_INT(mode, ecu.mode);
}

#endif
