#include "ecu/samples.h"

#include "can_protocol/generated/diarc.h"
#include "ecu/ecu.h"
#include "ecu/wire.h"

#define US_PER_STEP \
    1000u /* the limit of a pressure's change is for a millisecond, or the tick if that is shorter */
#define SENSOR_STATUS_INVALID DIARC_ENCODERS_SENSOR_STATUS_INVALID_CHOICE

static scalar angle_of(int32_t raw)
{
    return WIRE_DECODE_SMALL(raw, DIARC_ENCODERS_SWING_ANGLE);
}

/* A raw pressure has 16 bits: it is a share of what 2^16 steps are. */
#define PRESSURE_BITS 16
#define PRESSURE_FULL 65536

static scalar pressure_of(const struct ecu *ecu, uint16_t raw)
{
    return mul(scalar_from_small(raw, PRESSURE_BITS), ecu->full_pressure);
}

static int32_t raw_angle(scalar q)
{
    return WIRE_ENCODE(q, DIARC_ENCODERS_SWING_ANGLE, 0, -WIRE_MAX_S24, WIRE_MAX_S24);
}

static int32_t raw_pressure(const struct ecu *ecu, scalar p)
{
    return WIRE_ENCODE(p, DIARC_PRESSURES_SWING_BORE_PRESSURE, ecu->bases.pressure, 0, WIRE_MAX_U16);
}

void samples_start(struct ecu *ecu)
{
    const struct machine *const machine = &ecu->machine;
    const struct limits *const limits = &machine->limits;
    struct sample_limits *const raw = &ecu->sample_limits;
    ecu->full_pressure = WIRE_DECODE(PRESSURE_FULL, DIARC_PRESSURES_SWING_BORE_PRESSURE, ecu->bases.pressure);
    for (uint8_t i = 0; i < JOINTS; i++) {
        raw->angle_low[i] = raw_angle(machine->cylinder[i].q_min - limits->angle_range);
        raw->angle_high[i] = raw_angle(machine->cylinder[i].q_max + limits->angle_range);
        raw->angle_step[i] = raw_angle(mul(limits->rate[i], ecu->constants.dt_s));
    }
    raw->pressure_high = raw_pressure(ecu, limits->pressure_range);
    raw->pressure_step = raw_pressure(ecu, limits->pressure_step);
}

/* A frame that did not come, or was refused. */
static enum ecu_fault missing(const struct ecu *ecu, enum received_frame row)
{
    return ecu->receive.row[row].spoiled ? FAULT_SENSOR_FRAMES_CORRUPT : FAULT_SENSOR_FRAMES_LOST;
}

/* The sample a missing or wrong angle is replaced by: the reference and the observer's prediction. */
static int32_t predicted_angle(const struct ecu *ecu, enum joint i)
{
    const struct controller *const c = &ecu->controller;
    const scalar e1 = c->observer[i].e + mul(ecu->constants.dt_s, c->observer[i].w);
    const scalar q = trajectory_now(&c->trajectory[i]).q + e1;
    return WIRE_ENCODE(q, DIARC_TRACKING_SWING_REFERENCE, 0, -WIRE_MAX_S24, WIRE_MAX_S24);
}

static int32_t magnitude(int32_t x)
{
    return x < 0 ? -x : x;
}

static enum ecu_fault judge_angle(const struct ecu *ecu, enum joint i, int32_t raw, int32_t before)
{
    const struct sample_limits *const limits = &ecu->sample_limits;
    if (raw < limits->angle_low[i] || raw > limits->angle_high[i]) {
        return FAULT_SENSOR_RANGE;
    }
    if (!ecu->controller.armed) {
        return FAULT_NONE;
    }
    /* The sample before may be a prediction. The arm is not far from this tick's: an encoder that was missing or refused
     * has to come closer to that than one that is believed may move. */
    const bool doubted = ecu->supervision.sensors_wrong > 0u;
    const int32_t off = doubted ? 4 * magnitude(raw - predicted_angle(ecu, i)) : magnitude(raw - before);
    return off > limits->angle_step[i] ? FAULT_SENSOR_RATE : FAULT_NONE;
}

/* A pressure changes by less than this in the ticks since the last that was good; the same for all of them. */
static int32_t pressure_step_end(const struct ecu *ecu)
{
    if (!ecu->controller.armed) {
        return WIRE_MAX_U16 + 1; /* by anything */
    }
    /* what was kept over missing frames may have changed meanwhile; a value that was refused may not */
    const enum ecu_fault cause = ecu->supervision.wrong_cause;
    const bool kept = cause == FAULT_SENSOR_FRAMES_LOST || cause == FAULT_SENSOR_FRAMES_CORRUPT;
    const uint32_t ticks = kept ? 1u + ecu->supervision.sensors_wrong : 1u;
    const int32_t steps = (int32_t)((ticks * ecu->period_us + US_PER_STEP - 1u) / US_PER_STEP);
    /* as of an angle, a sensor that was refused has to come closer */
    const bool doubted = !kept && ecu->supervision.sensors_wrong > 0u;
    const int32_t most = ecu->sample_limits.pressure_step;
    return ((doubted ? most / 4 : most) + 1) * steps;
}

static enum ecu_fault judge_pressure(const struct ecu *ecu, uint16_t raw, uint16_t before, int32_t step_end)
{
    if (raw > ecu->sample_limits.pressure_high) {
        return FAULT_SENSOR_RANGE;
    }
    return magnitude((int32_t)raw - before) >= step_end ? FAULT_SENSOR_RATE : FAULT_NONE;
}

static enum ecu_fault take_angles(const struct ecu *ecu, struct sensor_samples *samples)
{
    if (!ecu->receive.row[RX_ENCODERS].fresh) {
        return missing(ecu, RX_ENCODERS);
    }
    struct diarc_encoders_t raw;
    const int done = diarc_encoders_unpack(&raw, ecu->receive.row[RX_ENCODERS].data, DIARC_ENCODERS_LENGTH);
    if (done != 0 || raw.sensor_status == SENSOR_STATUS_INVALID || raw.swing_angle == WIRE_INVALID_S24 ||
        raw.wrist_angle == WIRE_INVALID_S24) {
        return FAULT_SENSOR_INVALID;
    }
    enum ecu_fault wrong = judge_angle(ecu, SWING, raw.swing_angle, samples->angle[SWING]);
    if (wrong == FAULT_NONE) {
        wrong = judge_angle(ecu, WRIST, raw.wrist_angle, samples->angle[WRIST]);
    }
    if (wrong == FAULT_NONE) {
        samples->angle[SWING] = raw.swing_angle;
        samples->angle[WRIST] = raw.wrist_angle;
    }
    return wrong;
}

static enum ecu_fault take_pressures(const struct ecu *ecu, enum joint i, struct sensor_samples *samples,
                                     int32_t step_end)
{
    const enum received_frame row = i == SWING ? RX_PRESSURES_SWING : RX_PRESSURES_WRIST;
    if (!ecu->receive.row[row].fresh) {
        return missing(ecu, row);
    }
    /* Both frames have the same layout; the DBC has two only because identifiers differ. */
    struct diarc_pressures_swing_t raw;
    const int done =
        diarc_pressures_swing_unpack(&raw, ecu->receive.row[row].data, DIARC_PRESSURES_SWING_LENGTH);
    if (done != 0 || raw.sensor_status == SENSOR_STATUS_INVALID || raw.bore_pressure == WIRE_INVALID_U16 ||
        raw.annulus_pressure == WIRE_INVALID_U16 || raw.spool_position == WIRE_INVALID_S16) {
        return FAULT_SENSOR_INVALID;
    }
    enum ecu_fault wrong = judge_pressure(ecu, raw.bore_pressure, samples->pressure[i][BORE], step_end);
    if (wrong == FAULT_NONE) {
        wrong = judge_pressure(ecu, raw.annulus_pressure, samples->pressure[i][ANNULUS], step_end);
    }
    if (wrong == FAULT_NONE) {
        samples->pressure[i][BORE] = raw.bore_pressure;
        samples->pressure[i][ANNULUS] = raw.annulus_pressure;
        samples->spool[i] = raw.spool_position;
    }
    return wrong;
}

/* The later in this order says more: lost, corrupt, invalid, out of range, too fast. */
static enum ecu_fault worse(enum ecu_fault a, enum ecu_fault b)
{
    static const uint8_t RANK[] = {[FAULT_NONE] = 0,           [FAULT_SENSOR_FRAMES_LOST] = 1,
                                   [FAULT_SENSOR_INVALID] = 3, [FAULT_SENSOR_FRAMES_CORRUPT] = 2,
                                   [FAULT_SENSOR_RANGE] = 4,   [FAULT_SENSOR_RATE] = 5};
    return RANK[a] >= RANK[b] ? a : b;
}

enum ecu_fault samples_take(struct ecu *ecu)
{
    struct sensor_samples *const samples = &ecu->samples;
    enum ecu_fault wrong = take_angles(ecu, samples);
    if (wrong != FAULT_NONE && ecu->controller.armed) {
        samples->angle[SWING] = predicted_angle(ecu, SWING);
        samples->angle[WRIST] = predicted_angle(ecu, WRIST);
    }
    const int32_t step_end = pressure_step_end(ecu);
    wrong = worse(wrong, take_pressures(ecu, SWING, samples, step_end));
    return worse(wrong, take_pressures(ecu, WRIST, samples, step_end));
}

struct measurement samples_measured(const struct ecu *ecu, const struct sensor_samples *before)
{
    struct measurement m;
    const struct sensor_samples *const now = &ecu->samples;
    for (uint8_t i = 0; i < JOINTS; i++) {
        m.q[i] = angle_of(now->angle[i]);
        /* the difference of the integers: exact, whatever the number type */
        m.dq[i] = angle_of(now->angle[i] - before->angle[i]);
        m.p[i][BORE] = pressure_of(ecu, now->pressure[i][BORE]) - ecu->tare.offset[i][BORE];
        m.p[i][ANNULUS] = pressure_of(ecu, now->pressure[i][ANNULUS]) - ecu->tare.offset[i][ANNULUS];
        m.spool[i] = WIRE_DECODE_SMALL(now->spool[i], DIARC_PRESSURES_SWING_SPOOL_POSITION);
    }
    return m;
}
