#include "bench.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "modes_known.h"
#include "tests/unit/frames.h"
#include "tests/unit/parameter_images.h"

enum { SPOOL_MAX = 16384, CONTROL_DISABLED = 1, CONTROL_ACTIVE = 7 };

void must(bool holds, const char *what)
{
    if (!holds) {
        (void)fprintf(stderr, "broken: %s\n", what);
        abort();
    }
}

bool input_over(const struct input *input)
{
    return input->next >= input->length;
}

uint8_t input_u8(struct input *input)
{
    return input_over(input) ? 0 : input->bytes[input->next++];
}

uint16_t input_u16(struct input *input)
{
    const uint16_t low = input_u8(input);
    return (uint16_t)(low | input_u8(input) << 8);
}

uint32_t input_u32(struct input *input)
{
    const uint32_t low = input_u16(input);
    return low | (uint32_t)input_u16(input) << 16;
}

void input_numbers(struct input *input, uint8_t count, struct parameter_image *image)
{
    for (uint8_t n = 0; n < count; n++) {
        const uint32_t k = input_u8(input) % PARAMETER_COUNT;
        const uint16_t upper = input_u16(input);
        image->bytes[IMAGE_HEADER_BYTES + 4u * k + 2u] = (uint8_t)upper;
        image->bytes[IMAGE_HEADER_BYTES + 4u * k + 3u] = (uint8_t)(upper >> 8);
    }
}

/* ---- what must hold ---- */

static bool is_driving(uint8_t mode)
{
    return KNOWN_MODES[mode].drives;
}

/* Looked at with every call of the port, so hardly a mode is passed through unseen. */
static void watch_mode(struct bench *bench)
{
    const uint8_t now = (uint8_t)bench->ecu.mode;
    must(now < MODES_END && KNOWN_MODES[now].exists, "the mode is none");
    if (now != bench->mode) {
        const bool follows = (KNOWN_MODES[bench->mode].successors & TO(now)) != 0u;
        const bool restarted = bench->reset_asked && now == INIT;
        if (!follows && !restarted) {
            (void)fprintf(stderr, "mode %u to %u\n", bench->mode, now);
        }
        must(follows || restarted, "a mode follows that may not");
        bench->mode = now;
    }
}

static int32_t spool_limit(int16_t spool)
{
    return spool < 0 ? -(int32_t)spool : spool;
}

static void watch_valves(struct bench *bench, const struct can_frame_11bit *frame, bool taken)
{
    const uint8_t mode = (uint8_t)get_bits(frame->data, 12, 4);
    const int16_t spool[JOINTS] = {(int16_t)get_bits(frame->data, 16, 16),
                                   (int16_t)get_bits(frame->data, 32, 16)};
    const uint32_t control[JOINTS] = {get_bits(frame->data, 48, 4), get_bits(frame->data, 52, 4)};
    must(frame->length == 8u && e2e_intact(0x202, frame->data), "the valve frame is not protected");
    must(mode == (uint8_t)bench->ecu.mode, "the valve frame has another mode than the ECU");
    for (uint8_t i = 0; i < JOINTS; i++) {
        must(spool_limit(spool[i]) <= SPOOL_MAX, "a set-point is beyond the valve's travel");
        must(control[i] == CONTROL_DISABLED || control[i] == CONTROL_ACTIVE,
             "a valve's control word is none");
        if (!is_driving(mode)) {
            must(spool[i] == 0 && control[i] == CONTROL_DISABLED,
                 "valves are commanded in a mode without them");
        }
    }
    bench->valve_frames++;
    if (taken) {
        bench->bus_active = control[SWING] == CONTROL_ACTIVE || control[WRIST] == CONTROL_ACTIVE ||
                            spool[SWING] != 0 || spool[WRIST] != 0;
        memcpy(bench->spool, spool, sizeof spool);
    }
}

/* Between two bounds, so no NaN and not infinite either. */
static bool within(scalar x, scalar low, scalar high)
{
    return x >= low && x <= high;
}

#define FAR \
    SCALAR(60) /* near the end of fixed point; no quantity per unit comes near it in sound operation */

static bool is_number(scalar x)
{
    return within(x, -FAR, FAR);
}

#if defined(DIARC_SCALAR_FIXED)
static bool is_finite(scalar x)
{
    (void)x; /* overflow is the sanitizer's */
    return true;
}
#else
static bool is_finite(scalar x)
{
    return isfinite(x);
}
#endif

/* The law's estimate follows by steps, whose sum is rounded. */
static bool follows_within(scalar x, const struct prior *prior)
{
    const scalar rounding = mul(prior->high - prior->low, SCALAR(0x1p-20));
    return within(x, prior->low - rounding, prior->high + rounding);
}

static void watch_estimate(const struct ecu *ecu)
{
    const struct estimator *const e = &ecu->controller.estimator;
    for (uint8_t k = 0; k < THETA_M; k++) {
        const struct prior *const prior = &ecu->machine.estimator.m[k];
        must(within(e->theta_m[k], prior->low, prior->high), "theta_m is out of its bounds");
        must(follows_within(e->law_m[k], prior), "what the law sees of theta_m is out of its bounds");
        must(estimator_sd_m(e, &ecu->constants.estimator, (enum theta_m)k) >= SCALAR(0), "an sd is none");
    }
    for (uint8_t k = 0; k < THETA_H; k++) {
        const struct prior *const prior = &ecu->machine.estimator.h[k];
        must(within(e->theta_h[k], prior->low, prior->high), "theta_h is out of its bounds");
        must(follows_within(e->law_h[k], prior), "what the law sees of theta_h is out of its bounds");
        must(estimator_sd_h(e, &ecu->constants.estimator, (enum theta_h)k) >= SCALAR(0), "an sd is none");
    }
}

static void watch_law(const struct ecu *ecu)
{
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct joint_output *const out = &ecu->controller.output[i];
        must(within(out->u, SCALAR(-1), SCALAR(1)), "u is out of its bounds");
        must(is_number(out->e1) && is_number(out->reference.q), "the error or its reference is no number");
        must(is_number(ecu->controller.observer[i].e), "the observer's error is no number");
        must(is_finite(out->e1_rate) && is_finite(out->reference.w) && is_finite(out->reference.a),
             "a rate is no number");
    }
}

static void watch_tick(struct bench *bench, uint32_t ticks_before)
{
    const struct ecu *const ecu = &bench->ecu;
    watch_mode(bench);
    if (!parameter_set_coming(ecu)) { /* else there is no machine to look at */
        watch_estimate(ecu);
    }
    watch_law(ecu);
    must(ecu->sync_counter >= 1u && ecu->sync_counter <= 240u, "the SYNC counter leaves 1..240");
    must(ecu->counters.ticks == ticks_before + 1u || ecu->counters.ticks == 1u, "a tick is not counted");
    if (!is_driving(bench->mode) && !bench->send_failed) {
        must(!bench->bus_active, "the valves stay open in a mode without them");
    }
}

/* ---- the port ---- */

static const uint16_t SENT_IDS[] = {0x080, 0x081, 0x181, 0x202, 0x281, 0x381, 0x481, 0x581, 0x701};

static enum port_status bench_send(void *context, const struct can_frame_11bit *frame)
{
    struct bench *const bench = context;
    watch_mode(bench);
    bool known = false;
    for (size_t k = 0; k < sizeof SENT_IDS / sizeof SENT_IDS[0]; k++) {
        known = known || SENT_IDS[k] == frame->id;
    }
    must(known && frame->length <= 8u, "a frame is sent that is none of the ECU's");
    const bool taken = bench->sends_refused == 0u;
    if (frame->id == 0x202u) {
        watch_valves(bench, frame, taken);
    }
    if (!taken) {
        bench->sends_refused--;
        bench->send_failed = true;
        return bench->refusal;
    }
    if (frame->id == 0x581u) {
        must(bench->answer_count < BENCH_SDO, "SDO answers without end");
        bench->answers[bench->answer_count++] = *frame;
    }
    return PORT_OK;
}

static enum port_status bench_receive(void *context, struct can_frame_11bit *frame)
{
    struct bench *const bench = context;
    watch_mode(bench);
    if (bench->waiting_next >= bench->waiting_count) {
        bench->waiting_next = bench->waiting_count = 0;
        return PORT_EMPTY;
    }
    *frame = bench->waiting[bench->waiting_next++];
    const bool to_ecu = frame->id == 0u && frame->length == 2u && frame->data[1] <= 1u;
    bench->reset_asked = bench->reset_asked || (to_ecu && (frame->data[0] == 129u || frame->data[0] == 130u));
    return PORT_OK;
}

static uint32_t bench_now_us(void *context)
{
    struct bench *const bench = context;
    bench->now_us += 17u;
    return bench->now_us;
}

/* ---- the bus's other end ---- */

void bench_queue(struct bench *bench, struct can_frame_11bit frame)
{
    if (bench->waiting_count < BENCH_WAITING) {
        bench->waiting[bench->waiting_count++] = frame;
    }
}

void bench_nmt(struct bench *bench, uint8_t command, uint8_t node)
{
    bench_queue(bench, nmt_frame(command, node));
}

void bench_motion(struct bench *bench, uint8_t request, uint8_t joint, uint8_t controller, int32_t target,
                  uint16_t duration_ms)
{
    bench->motion_counter = (uint8_t)((bench->motion_counter + 1u) % E2E_COUNTER_STATES);
    bench_queue(bench, motion_frame(request, joint, controller, target, duration_ms, bench->motion_counter));
}

void bench_any_request(struct bench *bench, struct input *input)
{
    const uint8_t choice = input_u8(input);
    bench_motion(bench, choice & 0x0Fu, 0, choice >> 6, 0, 1);
}

void bench_any_nmt(struct bench *bench, uint8_t choice, uint8_t node)
{
    static const uint8_t commands[] = {1, 1, 2, 128, 129, 130};
    bench_nmt(bench, commands[choice % sizeof commands], node);
}

static int32_t noise(struct bench *bench)
{
    bench->random = bench->random * 1664525u + 1013904223u;
    const int32_t size = bench->sensors.noise;
    return (int32_t)((bench->random >> 16) % (uint32_t)(2 * size + 1)) - size;
}

static int32_t limited(int32_t x, int32_t low, int32_t high)
{
    return x < low ? low : x > high ? high : x;
}

/* Open valves move the joints, at most 0.5 rad/s at 1 kHz, and shift the pressures. */
static void follow(struct bench *bench)
{
    struct sensors *const s = &bench->sensors;
    for (uint8_t i = 0; i < JOINTS; i++) {
        s->angle[i] = limited(s->angle[i] + bench->spool[i] / 12, -8388607, 8388607);
        s->spool[i] = (int16_t)(s->spool[i] + (bench->spool[i] - s->spool[i]) / 4);
        const int32_t shift = bench->spool[i] / 32;
        s->pressure[i][BORE] = (uint16_t)limited(s->pressure[i][BORE] + shift / 16, 200, 20000);
        s->pressure[i][ANNULUS] = (uint16_t)limited(s->pressure[i][ANNULUS] - shift / 16, 200, 20000);
    }
}

static uint8_t sensor_counter(const struct bench *bench, enum sensor_frame which)
{
    const unsigned offset = bench->sensors.counter_offset[which];
    return (uint8_t)((bench->ecu.sync_counter - 1u + offset) % E2E_COUNTER_STATES);
}

static void queue_sensor(struct bench *bench, enum sensor_frame which, struct can_frame_11bit frame)
{
    const struct sensors *const s = &bench->sensors;
    if (s->silent[which]) {
        return;
    }
    if (s->bad_crc[which]) {
        frame.data[0] = (uint8_t)(frame.data[0] ^ 0x55u);
    }
    bench_queue(bench, frame);
}

static void queue_sensors(struct bench *bench)
{
    const struct sensors *const s = &bench->sensors;
    const int32_t swing = s->angle[SWING] + noise(bench);
    const int32_t wrist = s->angle[WRIST] + noise(bench);
    queue_sensor(bench, ENCODERS,
                 encoders_frame(swing, wrist, s->status[ENCODERS], sensor_counter(bench, ENCODERS)));
    for (uint8_t i = 0; i < JOINTS; i++) {
        const enum sensor_frame which = i == SWING ? PRESSURES_SWING : PRESSURES_WRIST;
        uint16_t pressure[CHAMBERS];
        for (uint8_t c = 0; c < CHAMBERS; c++) {
            pressure[c] = (uint16_t)(s->pressure[i][c] + noise(bench));
        }
        queue_sensor(
            bench, which,
            pressures_frame(i, pressure, s->spool[i], s->status[which], sensor_counter(bench, which)));
    }
}

bool bench_start(struct bench *bench, const struct parameter_image *image, uint32_t period_us)
{
    *bench = (struct bench){
        .port = {.context = bench, .send = bench_send, .receive = bench_receive, .now_us = bench_now_us},
        .sensors = {.plant_follows = true},
        .mode = INIT,
    };
    for (uint8_t i = 0; i < JOINTS; i++) {
        bench->sensors.angle[i] = 267013;
        memcpy(bench->sensors.pressure[i], REST_PRESSURE[i], sizeof REST_PRESSURE[i]);
    }
    uint16_t entry = 0;
    return ecu_init(&bench->ecu, image, period_us, &entry) == ECU_OK;
}

/* FUZZ_TRACE=1 in the environment: a line for each tick, to understand an input. */
static void trace(const struct bench *bench)
{
    if (getenv("FUZZ_TRACE") != NULL) {
        (void)fprintf(stderr, "tick %u mode %u nmt %u faults %08x refused %u spools %d %d%s%s\n",
                      (unsigned)bench->ecu.counters.ticks, (unsigned)bench->mode, (unsigned)bench->ecu.nmt,
                      (unsigned)bench->ecu.active_faults, (unsigned)bench->ecu.counters.refused,
                      bench->spool[SWING], bench->spool[WRIST], bench->bus_active ? " open" : "",
                      bench->send_failed ? " send failed" : "");
    }
}

void bench_tick(struct bench *bench)
{
    const uint32_t before = bench->ecu.counters.ticks;
    bench->send_failed = false;
    bench->answer_count = 0;
    bench->valve_frames = 0;
    if (bench->sensors.plant_follows) {
        follow(bench);
    }
    ecu_tick_begin(&bench->ecu, &bench->port);
    watch_mode(bench);
    bench->reset_asked = false;
    queue_sensors(bench);
    for (unsigned k = 0; k < 3u; k++) { /* more than it takes at once is left for the next tick */
        (void)ecu_tick_receive(&bench->ecu, &bench->port);
    }
    ecu_tick_end(&bench->ecu, &bench->port);
    trace(bench);
    watch_tick(bench, before);
}
