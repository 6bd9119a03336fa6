#include "ecu/ecu.h"

#include <stddef.h>

#include "can_protocol/generated/diarc.h"
#include "ecu/transmit.h"
#include "ecu/wire.h"

#define SYNC_COUNTER_LAST 240u /* CiA 301, 1019h */
#define SENSORS_WRONG_LIMIT 5u /* ticks in a row; one more is a fault in RUN */
#define SLOW_CYCLE_TICKS 10u   /* one slow frame in each of these phases, never two in a tick */
#define HEARTBEAT_US 100000u
#define TARE_US 100000u
#define TARE_LIMIT_RAW 1000 /* 5 bar from tank pressure: more is no sensor's error, the pump is on */
#define TARE_EXTRA_BITS 4   /* the mean is kept finer than a raw step */
#define US_PER_S 1000000u
#define US_PER_MS 1000u
#define NODE_ALL 0u
#define SENSOR_STATUS_INVALID DIARC_ENCODERS_SENSOR_STATUS_INVALID_CHOICE

enum slow_phase {
    PHASE_ESTIMATE = 1,
    PHASE_TRACKING = 3,
    PHASE_PARAMETER = 5,
    PHASE_TIMING = 7,
    PHASE_TRACKING_2 = 8
};

static void count_u16(uint16_t *counter)
{
    if (*counter < UINT16_MAX) {
        (*counter)++;
    }
}

/* Back to the state of power-on; parameters stay. Field by field: a copy of the whole would need its size in stack. */
static void restart(struct ecu *ecu)
{
    const bool sound = ecu->stored == STORE_OK || ecu->stored == STORE_EMPTY;
    ecu->mode = sound ? MODE_INIT : MODE_FAULT;
    ecu->nmt = NMT_PRE_OPERATIONAL;
    ecu->fault = sound ? FAULT_NONE : FAULT_STORE_DAMAGED;
    ecu->receive = (struct receive){0};
    ecu->samples = (struct sensor_samples){0};
    ecu->tare = (struct tare){0};
    ecu->sampled = false;
    ecu->sensors_wrong = 0;
    ecu->restart_requested = false;
    ecu->boot_up_due = true;
    ecu->run_requested = false;
    ecu->valves_active = false;
    ecu->run_controller = CONTROLLER_PID;
    ecu->sync_counter = 0;
    ecu->phase = 0;
    ecu->next_parameter = 0;
    ecu->next_page = 0;
    ecu->next_joint = 0;
    ecu->heartbeat_ticks = 0;
    for (uint8_t k = 0; k < ECU_TX_COUNTERS; k++) {
        ecu->tx_counter[k] = 0;
    }
    ecu->complete_at_us = 0;
    ecu->counters = (struct ecu_counters){0};
    controller_start(&ecu->controller, &ecu->machine, &ecu->constants);
}

enum ecu_status ecu_init(struct ecu *ecu, const struct parameter_image *image, uint32_t period_us,
                         uint16_t *entry)
{
    *ecu = (struct ecu){0};
    const enum ecu_status status =
        parameters_load(&ecu->machine, &ecu->bases, image != NULL ? image : &default_parameter_image, entry);
    if (status != ECU_OK) {
        return status;
    }
    const scalar dt_s = quot(scalar_from_raw((int32_t)period_us, 16), scalar_from_raw((int32_t)US_PER_S, 16));
    if (period_us < ECU_PERIOD_LOW_US || period_us > ECU_PERIOD_HIGH_US ||
        amp(ecu->machine.observer_bandwidth, dt_s) >= SCALAR(1)) {
        return ECU_PERIOD_RANGE;
    }
    ecu->period_us = period_us;
    ecu->constants = controller_constants(&ecu->machine, dt_s);
    restart(ecu);
    return ECU_OK;
}

enum ecu_status ecu_init_stored(struct ecu *ecu, const struct store_port *store,
                                struct parameter_image *buffer, const struct parameter_image *fallback,
                                uint32_t period_us, uint16_t *entry)
{
    enum store_status stored = store != NULL ? store_load(store, buffer) : STORE_EMPTY;
    if (stored == STORE_OK || stored == STORE_OLDER) {
        const enum ecu_status status = ecu_init(ecu, buffer, period_us, entry);
        if (status == ECU_OK) {
            ecu->stored = stored;
            restart(ecu);
            return ECU_OK;
        }
        stored = STORE_FOREIGN;
    }
    const enum ecu_status status = ecu_init(ecu, fallback, period_us, entry);
    if (status == ECU_OK) {
        ecu->stored = stored;
        restart(ecu);
    }
    return status;
}

static void send(struct ecu *ecu, const struct ecu_port *port, struct can_frame_11bit frame)
{
    if (port->send(port->context, &frame) != PORT_OK) {
        count_u16(&ecu->counters.send_drops);
    }
}

static void leave_run(struct ecu *ecu, enum ecu_mode mode)
{
    ecu->run_requested = false;
    controller_disarm(&ecu->controller);
    ecu->mode = mode;
}

static void send_valves(struct ecu *ecu, const struct ecu_port *port)
{
    send(ecu, port, transmit_valves(ecu));
    ecu->valves_active = ecu->mode == MODE_RUN;
}

/* One last frame that shuts the valves, when frames are about to stop with the valves open. */
static void shut_valves(struct ecu *ecu, const struct ecu_port *port)
{
    if (ecu->valves_active) {
        if (ecu->mode == MODE_RUN) {
            leave_run(ecu, MODE_STANDBY);
        }
        send_valves(ecu, port);
    }
}

void ecu_tick_begin(struct ecu *ecu, const struct ecu_port *port)
{
    if (ecu->restart_requested) {
        shut_valves(ecu, port);
        restart(ecu);
    }
    if (ecu->boot_up_due) {
        send(ecu, port, transmit_heartbeat(0));
        ecu->boot_up_due = false;
        if (ecu->fault == FAULT_STORE_DAMAGED) {
            send(ecu, port, transmit_emergency(ecu, 0x6300u)); /* data set */
        }
    }
    ecu->sync_counter = (uint8_t)(ecu->sync_counter % SYNC_COUNTER_LAST + 1u);
    receive_begin_tick(&ecu->receive, ecu->sync_counter);
    send(ecu, port, transmit_sync(ecu->sync_counter));
}

static void refuse(struct ecu *ecu, enum ecu_refusal reason)
{
    count_u16(&ecu->counters.refused);
    ecu->counters.last_refusal = reason;
}

static void enter_fault(struct ecu *ecu, const struct ecu_port *port, enum ecu_fault fault)
{
    leave_run(ecu, MODE_FAULT);
    ecu->fault = fault;
    /* 8100h communication, 5000h device hardware */
    send(ecu, port, transmit_emergency(ecu, fault == FAULT_SENSOR_FRAMES_LOST ? 0x8100u : 0x5000u));
}

static void nmt_command(struct ecu *ecu, const struct can_frame_11bit *frame)
{
    if (frame->length != DIARC_NMT_LENGTH || (frame->data[1] != NODE_ALL && frame->data[1] != ECU_NODE_ID)) {
        return;
    }
    switch (frame->data[0]) {
    case DIARC_NMT_COMMAND_START_CHOICE:
        ecu->nmt = NMT_OPERATIONAL;
        break;
    case DIARC_NMT_COMMAND_STOP_CHOICE:
    case DIARC_NMT_COMMAND_ENTER_PREOPERATIONAL_CHOICE:
        ecu->nmt = frame->data[0] == DIARC_NMT_COMMAND_STOP_CHOICE ? NMT_STOPPED : NMT_PRE_OPERATIONAL;
        ecu->run_requested = false;
        if (ecu->mode == MODE_RUN || ecu->mode == MODE_TARE) {
            leave_run(ecu, MODE_STANDBY);
        }
        break;
    case DIARC_NMT_COMMAND_RESET_NODE_CHOICE:
    case DIARC_NMT_COMMAND_RESET_COMMUNICATION_CHOICE:
        ecu->restart_requested = true;
        break;
    default:
        break;
    }
}

static enum ecu_refusal request_run(struct ecu *ecu, uint8_t kind)
{
    if (ecu->mode != MODE_STANDBY) {
        return REFUSAL_NOT_IN_STANDBY;
    }
    if (kind >= CONTROLLERS) {
        return REFUSAL_UNKNOWN_REQUEST;
    }
    ecu->run_requested = true; /* armed at this tick's end, when its samples are complete */
    ecu->run_controller = (enum controller_kind)kind;
    return REFUSAL_NONE;
}

static enum ecu_refusal request_move(struct ecu *ecu, const struct diarc_motion_t *motion)
{
    if (ecu->mode != MODE_RUN) {
        return REFUSAL_NOT_IN_RUN;
    }
    if (motion->joint >= JOINTS) {
        return REFUSAL_UNKNOWN_REQUEST;
    }
    struct trajectory *const trajectory = &ecu->controller.trajectory[motion->joint];
    const struct cylinder *const cylinder = &ecu->machine.cylinder[motion->joint];
    const scalar target = WIRE_DECODE(motion->target, DIARC_MOTION_TARGET, 0);
    const uint32_t ticks = motion->duration * US_PER_MS / ecu->period_us;
    if (trajectory_moving(trajectory)) {
        return REFUSAL_MOVE_UNDER_WAY;
    }
    if (target < cylinder->q_min || target > cylinder->q_max) {
        return REFUSAL_TARGET_OUT_OF_RANGE;
    }
    return trajectory_start(trajectory, target, ticks, ecu->constants.dt_s) ? REFUSAL_NONE
                                                                            : REFUSAL_DURATION_TOO_SHORT;
}

static enum ecu_refusal request_tare(struct ecu *ecu)
{
    if (ecu->mode != MODE_STANDBY || ecu->run_requested) {
        return REFUSAL_NOT_IN_STANDBY;
    }
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        ecu->tare.sum[n / CHAMBERS][n % CHAMBERS] = 0;
    }
    ecu->tare.samples = (uint16_t)(TARE_US / ecu->period_us);
    ecu->tare.samples_left = ecu->tare.samples;
    ecu->mode = MODE_TARE;
    return REFUSAL_NONE;
}

static enum ecu_refusal request_fault_reset(struct ecu *ecu, const struct ecu_port *port)
{
    if (ecu->mode != MODE_FAULT) {
        return REFUSAL_NO_FAULT_TO_RESET;
    }
    if (ecu->sensors_wrong > 0u) {
        return REFUSAL_SENSORS_NOT_FRESH;
    }
    if (ecu->fault == FAULT_STORE_DAMAGED) {
        ecu->stored = STORE_OK; /* confirmed: a restart does not ask again */
    }
    ecu->fault = FAULT_NONE;
    ecu->mode = MODE_STANDBY;
    send(ecu, port, transmit_emergency(ecu, 0));
    return REFUSAL_NONE;
}

static void motion_request(struct ecu *ecu, const struct ecu_port *port)
{
    struct diarc_motion_t motion = {0};
    (void)diarc_motion_unpack(&motion, ecu->receive.row[RX_MOTION].data, DIARC_MOTION_LENGTH);
    enum ecu_refusal refusal = REFUSAL_NONE;
    if (ecu->nmt != NMT_OPERATIONAL) {
        refusal = REFUSAL_NOT_OPERATIONAL;
    } else if (motion.request == DIARC_MOTION_REQUEST_RUN_CHOICE) {
        refusal = request_run(ecu, motion.controller);
    } else if (motion.request == DIARC_MOTION_REQUEST_MOVE_CHOICE) {
        refusal = request_move(ecu, &motion);
    } else if (motion.request == DIARC_MOTION_REQUEST_RESET_FAULT_CHOICE) {
        refusal = request_fault_reset(ecu, port);
    } else if (motion.request == DIARC_MOTION_REQUEST_TARE_CHOICE) {
        refusal = request_tare(ecu);
    } else if (motion.request == DIARC_MOTION_REQUEST_STANDBY_CHOICE) {
        ecu->run_requested = false;
        if (ecu->mode == MODE_RUN || ecu->mode == MODE_TARE) {
            leave_run(ecu, MODE_STANDBY);
        }
    } else if (motion.request != DIARC_MOTION_REQUEST_NONE_CHOICE) {
        refusal = REFUSAL_UNKNOWN_REQUEST;
    }
    if (refusal != REFUSAL_NONE) {
        refuse(ecu, refusal);
    }
}

bool ecu_tick_receive(struct ecu *ecu, const struct ecu_port *port)
{
    struct can_frame_11bit frame;
    const bool was_complete = receive_complete(&ecu->receive);
    /* At most this many a call: a bus full of strange frames must not hold up the tick. */
    for (uint8_t n = 0; n < UINT8_MAX && port->receive(port->context, &frame) == PORT_OK; n++) {
        if (frame.id == DIARC_NMT_FRAME_ID) {
            nmt_command(ecu, &frame);
            continue;
        }
        enum received_frame which = RX_FRAMES;
        if (receive_accept(&ecu->receive, &frame, &which) == RECEIVE_GOOD && which == RX_MOTION) {
            motion_request(ecu, port);
        }
    }
    const bool complete = receive_complete(&ecu->receive);
    if (complete && !was_complete) {
        ecu->complete_at_us = port->now_us(port->context);
    }
    return complete;
}

/* Unpack one joint's pressures; false when one is marked invalid. */
static bool unpack_pressures(const struct ecu *ecu, enum joint i, struct sensor_samples *samples)
{
    /* Both frames have the same layout; the DBC has two only because identifiers differ. */
    struct diarc_pressures_swing_t raw = {0};
    const enum received_frame row = i == SWING ? RX_PRESSURES_SWING : RX_PRESSURES_WRIST;
    (void)diarc_pressures_swing_unpack(&raw, ecu->receive.row[row].data, DIARC_PRESSURES_SWING_LENGTH);
    samples->pressure[i][BORE] = raw.bore_pressure;
    samples->pressure[i][ANNULUS] = raw.annulus_pressure;
    samples->spool[i] = raw.spool_position;
    return raw.sensor_status != SENSOR_STATUS_INVALID && raw.bore_pressure != WIRE_INVALID_U16 &&
           raw.annulus_pressure != WIRE_INVALID_U16 && raw.spool_position != WIRE_INVALID_S16;
}

static bool unpack_encoders(const struct ecu *ecu, struct sensor_samples *samples)
{
    struct diarc_encoders_t raw = {0};
    (void)diarc_encoders_unpack(&raw, ecu->receive.row[RX_ENCODERS].data, DIARC_ENCODERS_LENGTH);
    samples->angle[SWING] = raw.swing_angle;
    samples->angle[WRIST] = raw.wrist_angle;
    return raw.sensor_status != SENSOR_STATUS_INVALID && raw.swing_angle != WIRE_INVALID_S24 &&
           raw.wrist_angle != WIRE_INVALID_S24;
}

/* The sample a missing or wrong angle is replaced by: the reference and the observer's prediction. */
static int32_t predicted_angle(const struct ecu *ecu, enum joint i)
{
    const struct controller *const c = &ecu->controller;
    const scalar dt_s = ecu->constants.dt_s;
    const scalar e1 = c->observer[i].e + mul(dt_s, c->observer[i].w);
    const scalar q = trajectory_now(&c->trajectory[i]).q + e1;
    return WIRE_ENCODE(q, DIARC_TRACKING_SWING_REFERENCE, 0, -WIRE_MAX_S24, WIRE_MAX_S24);
}

/* This tick's samples. What is missing or wrong is predicted (angles, when armed) or kept (pressures).
 * Returns true when everything came and is valid. */
static bool take_samples(struct ecu *ecu, bool *invalid)
{
    struct sensor_samples next = ecu->samples;
    struct sensor_samples heard = ecu->samples;
    bool good = true;
    *invalid = false;
    if (ecu->receive.row[RX_ENCODERS].fresh && unpack_encoders(ecu, &heard)) {
        next.angle[SWING] = heard.angle[SWING];
        next.angle[WRIST] = heard.angle[WRIST];
    } else {
        good = false;
        *invalid = ecu->receive.row[RX_ENCODERS].fresh;
        if (ecu->controller.armed) {
            next.angle[SWING] = predicted_angle(ecu, SWING);
            next.angle[WRIST] = predicted_angle(ecu, WRIST);
        }
    }
    for (uint8_t i = 0; i < JOINTS; i++) {
        const enum received_frame row = i == SWING ? RX_PRESSURES_SWING : RX_PRESSURES_WRIST;
        if (ecu->receive.row[row].fresh && unpack_pressures(ecu, (enum joint)i, &heard)) {
            next.pressure[i][BORE] = heard.pressure[i][BORE];
            next.pressure[i][ANNULUS] = heard.pressure[i][ANNULUS];
            next.spool[i] = heard.spool[i];
        } else {
            good = false;
            *invalid = *invalid || ecu->receive.row[row].fresh;
        }
    }
    ecu->samples = next;
    return good;
}

static struct measurement measurement(const struct ecu *ecu, const struct sensor_samples *before)
{
    struct measurement m;
    const int8_t p = ecu->bases.pressure;
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct sensor_samples *const now = &ecu->samples;
        m.q[i] = WIRE_DECODE(now->angle[i], DIARC_ENCODERS_SWING_ANGLE, 0);
        /* the difference of the integers: exact, whatever the number type */
        m.dq[i] = WIRE_DECODE(now->angle[i] - before->angle[i], DIARC_ENCODERS_SWING_ANGLE, 0);
        m.p[i][BORE] = WIRE_DECODE(now->pressure[i][BORE], DIARC_PRESSURES_SWING_BORE_PRESSURE, p) -
                       ecu->tare.offset[i][BORE];
        m.p[i][ANNULUS] = WIRE_DECODE(now->pressure[i][ANNULUS], DIARC_PRESSURES_SWING_ANNULUS_PRESSURE, p) -
                          ecu->tare.offset[i][ANNULUS];
        m.spool[i] = WIRE_DECODE(now->spool[i], DIARC_PRESSURES_SWING_SPOOL_POSITION, 0);
    }
    return m;
}

/* Modes that follow from the sensors; requests have been taken as they came. */
static void supervise(struct ecu *ecu, const struct ecu_port *port, bool good, bool invalid)
{
    if (good) {
        ecu->sensors_wrong = 0;
    } else if (ecu->sensors_wrong < UINT8_MAX) {
        ecu->sensors_wrong++;
    }
    const bool gone = ecu->sensors_wrong > SENSORS_WRONG_LIMIT;
    switch (ecu->mode) {
    case MODE_INIT:
        if (good && ecu->nmt == NMT_OPERATIONAL) {
            ecu->mode = MODE_STANDBY;
        }
        break;
    case MODE_STANDBY:
    case MODE_TARE:
        if (gone) {
            ecu->mode = MODE_INIT;
        }
        break;
    case MODE_RUN:
        if (gone) {
            enter_fault(ecu, port, invalid ? FAULT_SENSOR_INVALID : FAULT_SENSOR_FRAMES_LOST);
        }
        break;
    case MODE_FAULT:
    default:
        break;
    }
}

/* One sample of the tare; with the last one its offsets, or a refusal when the chambers are not at tank pressure. */
static void tare_step(struct ecu *ecu, bool good)
{
    struct tare *const tare = &ecu->tare;
    if (ecu->mode != MODE_TARE || !good) {
        return;
    }
    for (uint8_t i = 0; i < JOINTS; i++) {
        tare->sum[i][BORE] += ecu->samples.pressure[i][BORE];
        tare->sum[i][ANNULUS] += ecu->samples.pressure[i][ANNULUS];
    }
    tare->samples_left--;
    if (tare->samples_left > 0u) {
        return;
    }
    ecu->mode = MODE_STANDBY;
    const int8_t base = ecu->bases.pressure;
    const scalar tank = ecu->machine.supply.p_tank;
    const scalar limit_Pa = WIRE_DECODE(TARE_LIMIT_RAW, DIARC_PRESSURES_SWING_BORE_PRESSURE, base);
    scalar offset[JOINTS * CHAMBERS];
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        const int32_t sum = tare->sum[n / CHAMBERS][n % CHAMBERS];
        const int32_t mean = sum * (1 << TARE_EXTRA_BITS) / tare->samples;
        const scalar p =
            WIRE_DECODE(mean, DIARC_PRESSURES_SWING_BORE_PRESSURE, (int8_t)(base + TARE_EXTRA_BITS));
        offset[n] = p - tank;
        if (absolute(offset[n]) > limit_Pa) {
            refuse(ecu, REFUSAL_NOT_DEPRESSURISED); /* the offsets of the last good tare stay */
            return;
        }
    }
    for (uint8_t n = 0; n < JOINTS * CHAMBERS; n++) {
        tare->offset[n / CHAMBERS][n % CHAMBERS] = offset[n];
    }
}

static void arm_if_requested(struct ecu *ecu, bool good, const struct measurement *measured)
{
    if (!ecu->run_requested) {
        return;
    }
    ecu->run_requested = false;
    if (!good || ecu->mode != MODE_STANDBY) {
        refuse(ecu, REFUSAL_SENSORS_NOT_FRESH);
        return;
    }
    controller_arm(&ecu->controller, ecu->run_controller, measured->q);
    ecu->mode = MODE_RUN;
}

static void send_slow_frames(struct ecu *ecu, const struct ecu_port *port)
{
    switch (ecu->phase) {
    case PHASE_ESTIMATE:
        send(ecu, port, transmit_estimate(ecu));
        break;
    case PHASE_TRACKING:
    case PHASE_TRACKING_2:
        send(ecu, port, transmit_tracking(ecu));
        break;
    case PHASE_PARAMETER:
        send(ecu, port, transmit_parameter(ecu));
        break;
    case PHASE_TIMING:
        send(ecu, port, transmit_timing(ecu));
        break;
    default:
        break;
    }
}

void ecu_tick_end(struct ecu *ecu, const struct ecu_port *port)
{
    if (!receive_complete(&ecu->receive)) {
        count_u16(&ecu->counters.late_ticks);
        ecu->complete_at_us = port->now_us(port->context);
    }
    receive_end_tick(&ecu->receive);

    const struct sensor_samples before = ecu->samples;
    bool invalid = false;
    const bool good = take_samples(ecu, &invalid);
    if (good || ecu->sampled) {
        const struct measurement measured = measurement(ecu, ecu->sampled ? &before : &ecu->samples);
        if (!good && !ecu->controller.armed) {
            controller_gap(&ecu->controller);
        }
        ecu->sampled = true;
        supervise(ecu, port, good, invalid);
        tare_step(ecu, good);
        arm_if_requested(ecu, good, &measured);
        controller_step(&ecu->controller, &ecu->machine, &ecu->constants, &measured);
    }

    if (ecu->nmt == NMT_OPERATIONAL) {
        send_valves(ecu, port);
        const uint32_t tick_time_us = port->now_us(port->context) - ecu->complete_at_us;
        ecu->counters.tick_time_us = tick_time_us < UINT16_MAX ? (uint16_t)tick_time_us : UINT16_MAX;
        send_slow_frames(ecu, port);
    } else {
        shut_valves(ecu, port);
    }
    if (ecu->heartbeat_ticks == 0u) {
        send(ecu, port, transmit_heartbeat((uint8_t)ecu->nmt));
        ecu->heartbeat_ticks = (uint16_t)(HEARTBEAT_US / ecu->period_us);
    }
    ecu->heartbeat_ticks--;
    ecu->phase = (uint8_t)((ecu->phase + 1u) % SLOW_CYCLE_TICKS);
    ecu->counters.ticks++;
}

void ecu_shutdown(struct ecu *ecu, const struct ecu_port *port)
{
    if (ecu->mode == MODE_RUN) {
        leave_run(ecu, MODE_STANDBY);
    }
    send_valves(ecu, port);
}
