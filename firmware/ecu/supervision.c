#include "ecu/supervision.h"

#include "can_protocol/generated/diarc.h"
#include "can_protocol/generated/diarc_hash.h"
#include "ecu/ecu.h"
#include "ecu/operation.h"
#include "ecu/wire.h"

#define OUTSIDE_TICKS 3u                 /* a limit is exceeded when it is for so many ticks in a row */
#define SPOOL_S SCALAR(0.01)             /* a spool may lag that long behind its set-point */
#define STUCK_TICKS_LEAST 20u            /* noise may give the same raw value a few times */
#define CONTRADICTION_SHARE SCALAR(0.25) /* of a window's, in the low pass */
#define REOPENED_MOST 3u                 /* changed loads within the window that are no loads any more */
#define DUPLICATE_TICKS 100u
#define HEARTBEAT_BASE 0x700u
#define ID_MASK 0x7Fu
#define US_PER_MS 1000u
#define CONSUMER_US_LAST (UINT32_C(1) << 31)

static void count_u8(uint8_t *counter)
{
    *counter = *counter < UINT8_MAX ? (uint8_t)(*counter + 1u) : UINT8_MAX;
}

static void count_u16(uint16_t *counter)
{
    *counter = *counter < UINT16_MAX ? (uint16_t)(*counter + 1u) : UINT16_MAX;
}

static uint16_t at_least(uint16_t ticks, uint16_t least)
{
    return ticks < least ? least : ticks;
}

static uint16_t at_least_one_u16(uint32_t ticks)
{
    if (ticks < 1u) {
        return 1u;
    }
    return ticks < UINT16_MAX ? (uint16_t)ticks : UINT16_MAX;
}

/* A parameter in seconds, 0..100, in ticks. */
static uint16_t ticks_of(scalar seconds, uint32_t period_us)
{
    /* from 2^-16 s to us: 15.2587890625 = 15 + 265/1024, so that nothing exceeds 32 bits */
    const uint32_t parts = (uint32_t)scalar_to_raw(seconds, 16, 0, 100 * 65536);
    const uint32_t time_us = parts * 15u + parts / 1024u * 265u + parts % 1024u * 265u / 1024u;
    return at_least_one_u16((time_us + period_us / 2u) / period_us);
}

static uint8_t count_of(scalar number)
{
    return (uint8_t)scalar_to_raw(number, 0, 1, UINT8_MAX - 1);
}

void supervision_start(struct ecu *ecu)
{
    samples_start(ecu);
    const struct limits *const limits = &ecu->machine.limits;
    const uint32_t period_us = ecu->period_us;
    ecu->supervision = (struct supervision){
        .stop_ticks = ticks_of(limits->stop_s, period_us),
        .stuck_ticks = at_least(ticks_of(limits->stuck_s, period_us), STUCK_TICKS_LEAST),
        .spool_ticks = ticks_of(SPOOL_S, period_us),
        .persist_ticks = ticks_of(limits->persist_s, period_us),
        .saturation_ticks = ticks_of(limits->saturation_s, period_us),
        .bound_ticks = ticks_of(limits->bound_s, period_us),
        .second_ticks = ticks_of(SCALAR(1), period_us),
        .wrong_limit = count_of(limits->sensor_wrong_ticks),
        .mismatch_limit = count_of(limits->mismatch_updates),
        .late_limit = count_of(limits->late_ticks),
        .send_limit = count_of(limits->send_ticks),
    };
}

void supervision_arm(struct ecu *ecu, const struct measurement *measured)
{
    struct supervision *const s = &ecu->supervision;
    const scalar margin = ecu->machine.limits.angle_margin;
    for (uint8_t n = 0; n < LASTING; n++) {
        s->lasting[n] = 0;
    }
    for (uint8_t i = 0; i < JOINTS; i++) {
        /* an arm that is outside already may come back: only farther out is a fault */
        const struct cylinder *const cylinder = &ecu->machine.cylinder[i];
        s->range[i][0] = smaller(cylinder->q_min, measured->q[i]) - margin;
        s->range[i][1] = larger(cylinder->q_max, measured->q[i]) + margin;
        s->seen_angle[i] = ecu->samples.angle[i];
        s->stuck_travel[i] = SCALAR(0);
        s->force[i] = ecu->controller.estimator.hydraulics[i].force;
        s->contradiction[i] = SCALAR(0);
        s->stuck_for[i][BORE] = 0;
        s->stuck_for[i][ANNULUS] = 0;
    }
    s->reopened = ecu->controller.estimator.reopened;
    s->late_starts = 0;
    s->window = 0;
}

/* True once the condition has held for `ticks` in a row. */
static bool lasts(struct supervision *s, enum lasting which, bool condition, uint16_t ticks)
{
    if (!condition) {
        s->lasting[which] = 0;
        return false;
    }
    count_u16(&s->lasting[which]);
    return s->lasting[which] >= ticks;
}

/* The set-points are those of the tick before: the law has not run yet. */
static void watch_spools(struct ecu *ecu, const struct ecu_port *port)
{
    for (uint8_t i = 0; i < JOINTS; i++) {
        const scalar spool = WIRE_DECODE_SMALL(ecu->samples.spool[i], DIARC_PRESSURES_SWING_SPOOL_POSITION);
        const bool far = absolute(ecu->controller.output[i].u - spool) > ecu->machine.limits.spool_error;
        if (lasts(&ecu->supervision, i == SWING ? LASTING_SPOOL_SWING : LASTING_SPOOL_WRIST, far,
                  ecu->supervision.spool_ticks)) {
            fault_raise(ecu, port, FAULT_VALVE_NOT_FOLLOWING);
        }
    }
}

void supervise_sensors(struct ecu *ecu, const struct ecu_port *port, enum ecu_fault wrong)
{
    struct supervision *const s = &ecu->supervision;
    if (wrong == FAULT_NONE) {
        s->sensors_wrong = 0;
        if (ecu->controller.armed) {
            watch_spools(ecu, port);
        }
        (void)operation_event(ecu, EVENT_SENSORS_READY);
        return;
    }
    count_u8(&s->sensors_wrong);
    s->wrong_cause = wrong;
    if (!supervision_sensors_gone(ecu)) {
        return;
    }
    if (ecu->controller.armed) {
        fault_raise(ecu, port, wrong);
    }
    (void)operation_event(ecu, EVENT_SENSORS_GONE);
}

bool supervision_sensors_gone(const struct ecu *ecu)
{
    return ecu->supervision.sensors_wrong > ecu->supervision.wrong_limit;
}

/* A fault that degrades: raised with its cause, cleared a second after it was last seen. */
static void degrade(struct ecu *ecu, const struct ecu_port *port, enum ecu_fault fault, enum clearing which,
                    bool cause)
{
    uint16_t *const clear = &ecu->supervision.clear[which];
    if (cause) {
        *clear = ecu->supervision.second_ticks;
        fault_raise(ecu, port, fault);
    } else if (*clear > 0u) {
        (*clear)--;
    } else {
        fault_clear(ecu, port, fault);
    }
}

static void watch_stuck(struct ecu *ecu, const struct ecu_port *port, enum joint i,
                        const struct sensor_samples *before)
{
    struct supervision *const s = &ecu->supervision;
    const struct sensor_samples *const now = &ecu->samples;
    const scalar w = absolute(ecu->controller.output[i].reference.w);
    const bool replaced = s->sensors_wrong > 0u;
    /* a predicted angle says nothing, but what the reference travels meanwhile counts */
    if (!replaced && now->angle[i] != s->seen_angle[i]) {
        s->seen_angle[i] = now->angle[i];
        s->stuck_travel[i] = SCALAR(0);
    } else {
        s->stuck_travel[i] = add_limited(s->stuck_travel[i], mul(w, ecu->constants.dt_s));
    }
    bool stuck = !replaced && s->stuck_travel[i] > ecu->machine.limits.stuck_travel;
    for (uint8_t k = 0; k < CHAMBERS; k++) {
        if (now->pressure[i][k] != before->pressure[i][k]) {
            s->stuck_for[i][k] = 0;
        } else if (!replaced && w > ecu->machine.estimator.gate_rate) {
            count_u16(&s->stuck_for[i][k]);
        } else {
            /* at rest a pressure may stay the same */
        }
        stuck = stuck || s->stuck_for[i][k] >= s->stuck_ticks;
    }
    if (stuck) {
        fault_raise(ecu, port, FAULT_SENSOR_STUCK);
    }
}

/* Encoder against oil. A joint's window ends with the tick of its hydraulics, of which the estimator keeps the samples:
 *     lamA R w + F'/be - (QL - leakage) = 0, over lamA R: the rate that the two do not agree on. */
static void watch_contradiction(struct ecu *ecu, const struct ecu_port *port, enum joint i)
{
    struct supervision *const s = &ecu->supervision;
    const struct estimator *const e = &ecu->controller.estimator;
    const struct estimator_constants *const constants = &ecu->constants.estimator;
    const struct hydraulics *const h = &e->hydraulics[i];
    const scalar w = amp(constants->per_window, sum_of_window(e->window.dq[i]));
    const scalar oil = sum_of_window(e->window.flow[i]) -
                       amp(constants->per_window, mul(e->theta_h[BETA_INVERSE], h->force - s->force[i]));
    const scalar oil_w = quot(oil, h->lamA_R);
    s->force[i] = h->force;
    s->contradiction[i] += mul(CONTRADICTION_SHARE, w - oil_w - s->contradiction[i]);
    const scalar most = ecu->machine.limits.contradiction + mul(SCALAR(0.25), absolute(oil_w));
    if (absolute(s->contradiction[i]) > most) {
        fault_raise(ecu, port, FAULT_SENSORS_CONTRADICT);
    }
}

static void watch_joint(struct ecu *ecu, const struct ecu_port *port, enum joint i,
                        const struct measurement *measured)
{
    struct supervision *const s = &ecu->supervision;
    const struct joint_output *const out = &ecu->controller.output[i];
    const scalar q = measured->q[i];
    if (lasts(s, i == SWING ? LASTING_LIMIT_SWING : LASTING_LIMIT_WRIST,
              q < s->range[i][0] || q > s->range[i][1], OUTSIDE_TICKS)) {
        fault_raise(ecu, port, FAULT_JOINT_LIMIT);
    }
    const bool saturated = out->u <= SCALAR(-1) || out->u >= SCALAR(1);
    if (lasts(s, i == SWING ? LASTING_SATURATED_SWING : LASTING_SATURATED_WRIST, saturated,
              s->saturation_ticks)) {
        fault_raise(ecu, port, FAULT_VALVE_SATURATED);
    }
}

/* Highest and lowest pressure of all chambers. */
static void extremes(const struct measurement *measured, scalar *lowest, scalar *highest)
{
    *lowest = measured->p[SWING][BORE];
    *highest = *lowest;
    for (uint8_t n = 1; n < JOINTS * CHAMBERS; n++) {
        const scalar p = measured->p[n / CHAMBERS][n % CHAMBERS];
        *lowest = smaller(*lowest, p);
        *highest = larger(*highest, p);
    }
}

/* While the estimate is held its innovations say nothing: a second later it is tried again. */
static void watch_estimate(struct ecu *ecu, const struct ecu_port *port)
{
    struct supervision *const s = &ecu->supervision;
    struct estimator *const estimator = &ecu->controller.estimator;
    const struct prior *const load = &ecu->machine.estimator.m[M_T];
    const bool mismatch = estimator->hydraulics[SWING].strikes >= s->mismatch_limit ||
                          estimator->hydraulics[WRIST].strikes >= s->mismatch_limit ||
                          (uint16_t)(estimator->reopened - s->reopened) >= REOPENED_MOST;
    if (mismatch) {
        estimator->hydraulics[SWING].strikes = 0;
        estimator->hydraulics[WRIST].strikes = 0;
        s->reopened = estimator->reopened;
    }
    degrade(ecu, port, FAULT_MODEL_MISMATCH, CLEARING_MISMATCH, mismatch);

    const scalar m_t = estimator->theta_m[M_T];
    const bool at_bound =
        !estimator->held && !estimator->commissioning && (m_t <= load->low || m_t >= load->high);
    degrade(ecu, port, FAULT_ESTIMATE_AT_BOUND, CLEARING_BOUND,
            lasts(s, LASTING_AT_BOUND, at_bound, s->bound_ticks));
}

static void watch_arm(struct ecu *ecu, const struct ecu_port *port, const struct sensor_samples *before,
                      const struct measurement *measured)
{
    struct supervision *const s = &ecu->supervision;
    const struct limits *const limits = &ecu->machine.limits;
    scalar lowest;
    scalar highest;
    extremes(measured, &lowest, &highest);
    if (lasts(s, LASTING_OVER_PRESSURE, highest > limits->pressure_max, OUTSIDE_TICKS)) {
        fault_raise(ecu, port, FAULT_OVER_PRESSURE);
    }
    degrade(ecu, port, FAULT_CAVITATION, CLEARING_CAVITATION,
            lasts(s, LASTING_CAVITATION, lowest < limits->pressure_min, s->persist_ticks));
    const struct joint_output *const out = ecu->controller.output;
    const scalar error = larger(absolute(out[SWING].e1), absolute(out[WRIST].e1));
    if (lasts(s, LASTING_ERROR, error > limits->tracking_error, OUTSIDE_TICKS)) {
        fault_raise(ecu, port, FAULT_TRACKING_ERROR);
    }
    watch_estimate(ecu, port);
    for (uint8_t i = 0; i < JOINTS; i++) {
        watch_joint(ecu, port, (enum joint)i, measured);
        watch_stuck(ecu, port, (enum joint)i, before);
        if (estimator_window_ended(&ecu->controller.estimator, (enum joint)i)) {
            watch_contradiction(ecu, port, (enum joint)i);
        }
    }
}

/* What is consumed, object 1016h: node in bits 16..22, time in ms below; 0 is nobody. */
static bool consumer_silent(const struct ecu *ecu)
{
    const uint32_t time_ms = ecu->heartbeat_consumer & 0xFFFFu;
    const struct supervision *const s = &ecu->supervision;
    return s->consumer_heard && time_ms > 0u && s->consumer_us > time_ms * US_PER_MS;
}

void supervise_bus(struct ecu *ecu, const struct ecu_port *port)
{
    struct supervision *const s = &ecu->supervision;
    if (s->consumer_us < CONSUMER_US_LAST) {
        s->consumer_us += ecu->period_us;
    }
    if (consumer_silent(ecu) && ecu->controller.armed) {
        fault_raise(ecu, port, FAULT_HEARTBEAT_LOST);
    }
    if (s->late_starts > s->late_limit && ecu->controller.armed) {
        fault_raise(ecu, port, FAULT_LATE_TICKS);
    }
    if (s->send_failures > s->send_limit && mode_drives(ecu->mode)) {
        fault_raise(ecu, port, FAULT_SEND_FAILED);
    }
    if (s->duplicate_ticks > 0u) {
        s->duplicate_ticks--;
        fault_raise(ecu, port, FAULT_DUPLICATE_NODE);
    }
    if (ecu->master_hash != 0u && ecu->master_hash != DIARC_DBC_HASH) {
        fault_raise(ecu, port, FAULT_DBC_MISMATCH);
    }
    s->window++;
    if (s->window >= s->second_ticks) {
        s->window = 0;
        s->late_starts = 0;
        s->reopened = ecu->controller.estimator.reopened;
    }
}

void supervise_machine(struct ecu *ecu, const struct ecu_port *port, const struct sensor_samples *before,
                       const struct measurement *measured)
{
    if (ecu->controller.armed) {
        watch_arm(ecu, port, before, measured);
    } else {
        /* nobody looks any more: what degrades leaves a second later all the same */
        degrade(ecu, port, FAULT_MODEL_MISMATCH, CLEARING_MISMATCH, false);
        degrade(ecu, port, FAULT_CAVITATION, CLEARING_CAVITATION, false);
        degrade(ecu, port, FAULT_ESTIMATE_AT_BOUND, CLEARING_BOUND, false);
    }
}

void supervise_frame(struct ecu *ecu, const struct can_frame_11bit *frame)
{
    struct supervision *const s = &ecu->supervision;
    const uint32_t consumed = (ecu->heartbeat_consumer >> 16) & ID_MASK;
    if (consumed != 0u && frame->id == HEARTBEAT_BASE + consumed) {
        s->consumer_heard = true;
        s->consumer_us = 0;
    }
    if (frame->id == DIARC_SYNC_FRAME_ID || frame->id == DIARC_VALVES_FRAME_ID ||
        frame->id == DIARC_ESTIMATE_FRAME_ID || frame->id == DIARC_HEARTBEAT_ECU_FRAME_ID) {
        s->duplicate_ticks = DUPLICATE_TICKS;
    }
}

bool supervision_cause_gone(const struct ecu *ecu)
{
    const struct supervision *const s = &ecu->supervision;
    const struct measurement now = samples_measured(ecu, &ecu->samples);
    scalar lowest;
    scalar highest;
    extremes(&now, &lowest, &highest);
    return s->duplicate_ticks == 0u && s->send_failures == 0u && !consumer_silent(ecu) &&
           (ecu->master_hash == 0u || ecu->master_hash == DIARC_DBC_HASH) &&
           highest <= ecu->machine.limits.pressure_max;
}
