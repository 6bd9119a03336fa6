#include "ecu/requests.h"

#include "can_protocol/generated/diarc.h"
#include "ecu/ecu.h"
#include "ecu/operation.h"
#include "ecu/wire.h"

#define US_PER_MS 1000u
#define CONTROL_STATE_MASK 0x7u
#define CONTROL_RESET 0x8u
#define CONTROL_DISABLED 1u
#define CONTROL_HOLD 3u
#define CONTROL_ACTIVE 7u

void request_refused(struct ecu *ecu, enum ecu_refusal reason)
{
    if (reason == REFUSAL_NONE) {
        return;
    }
    if (ecu->counters.refused < UINT16_MAX) {
        ecu->counters.refused++;
    }
    ecu->counters.last_refusal = reason;
}

/* A start waits for this tick's samples, which may still be on their way; what cannot be is said at once. */
static enum ecu_refusal start_later(struct ecu *ecu, enum ecu_event event)
{
    const struct mode_conditions hopeful = {.operational = ecu->nmt == NMT_OPERATIONAL, .sensors_good = true};
    enum ecu_mode next = ecu->mode;
    const enum ecu_refusal refusal = modes_next(ecu->mode, event, &hopeful, &next);
    if (refusal == REFUSAL_NONE) {
        ecu->pending = event;
        ecu->is_pending = true;
    }
    return refusal;
}

enum ecu_refusal request_event(struct ecu *ecu, const struct ecu_port *port, enum ecu_event event)
{
    const bool starts = event == EVENT_RUN || event == EVENT_COMMISSION || event == EVENT_HOLD;
    if (parameter_set_coming(ecu) && (starts || event == EVENT_TARE)) {
        return REFUSAL_NOT_IN_STANDBY; /* there is no machine until the set has come */
    }
    if (starts) {
        return start_later(ecu, event);
    }
    if (event == EVENT_TARE && ecu->is_pending) {
        return REFUSAL_NOT_IN_STANDBY; /* it is about to be left */
    }
    const enum ecu_refusal refusal = operation_event(ecu, event);
    if (event == EVENT_STANDBY || event == EVENT_SAFE_STOP || event == EVENT_NMT_LEFT) {
        ecu->is_pending = false; /* the later request wins */
    }
    if (event == EVENT_RESET_FAULT && refusal == REFUSAL_NONE) {
        ecu->stored = STORE_OK; /* confirmed: a restart does not ask again */
        fault_clear_all(ecu, port);
        (void)operation_event(ecu, EVENT_SENSORS_READY);
    }
    return refusal;
}

void request_pending(struct ecu *ecu)
{
    if (ecu->is_pending) {
        ecu->is_pending = false;
        request_refused(ecu, operation_event(ecu, ecu->pending));
    }
}

static enum ecu_refusal request_move(struct ecu *ecu, const struct diarc_motion_t *motion)
{
    if (ecu->mode != MODE_RUN && ecu->mode != MODE_COMMISSION) {
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

static enum ecu_refusal request_start(struct ecu *ecu, const struct ecu_port *port, enum ecu_event event,
                                      uint8_t controller)
{
    if (controller >= (uint8_t)CONTROLLERS) {
        return REFUSAL_UNKNOWN_REQUEST;
    }
    const enum ecu_refusal refusal = request_event(ecu, port, event);
    if (refusal == REFUSAL_NONE && !mode_drives(ecu->mode)) {
        ecu->requested_controller = (enum controller_kind)controller;
    }
    return refusal;
}

static enum ecu_refusal motion_refusal(struct ecu *ecu, const struct ecu_port *port,
                                       const struct diarc_motion_t *motion)
{
    if (ecu->nmt != NMT_OPERATIONAL) {
        return REFUSAL_NOT_OPERATIONAL;
    }
    switch (motion->request) {
    case DIARC_MOTION_REQUEST_NONE_CHOICE:
        return REFUSAL_NONE;
    case DIARC_MOTION_REQUEST_STANDBY_CHOICE:
        return request_event(ecu, port, EVENT_STANDBY);
    case DIARC_MOTION_REQUEST_RUN_CHOICE:
        return request_start(ecu, port, EVENT_RUN, motion->controller);
    case DIARC_MOTION_REQUEST_COMMISSION_CHOICE:
        return request_start(ecu, port, EVENT_COMMISSION, motion->controller);
    case DIARC_MOTION_REQUEST_HOLD_CHOICE:
        return request_start(ecu, port, EVENT_HOLD, motion->controller);
    case DIARC_MOTION_REQUEST_MOVE_CHOICE:
        return request_move(ecu, motion);
    case DIARC_MOTION_REQUEST_RESET_FAULT_CHOICE:
        return request_event(ecu, port, EVENT_RESET_FAULT);
    case DIARC_MOTION_REQUEST_TARE_CHOICE:
        return request_event(ecu, port, EVENT_TARE);
    case DIARC_MOTION_REQUEST_SAFE_STOP_CHOICE:
        return request_event(ecu, port, EVENT_SAFE_STOP);
    default:
        return REFUSAL_UNKNOWN_REQUEST;
    }
}

void request_motion(struct ecu *ecu, const struct ecu_port *port)
{
    struct diarc_motion_t motion = {0};
    (void)diarc_motion_unpack(&motion, ecu->receive.row[RX_MOTION].data, DIARC_MOTION_LENGTH);
    request_refused(ecu, motion_refusal(ecu, port, &motion));
}

enum ecu_refusal request_control_word(struct ecu *ecu, const struct ecu_port *port, uint16_t word)
{
    const bool reset = (word & CONTROL_RESET) != 0u && (ecu->control_word & CONTROL_RESET) == 0u;
    ecu->control_word = word;
    enum ecu_refusal refusal = REFUSAL_NONE;
    if (reset && ecu->mode == MODE_FAULT) {
        refusal = request_event(ecu, port, EVENT_RESET_FAULT);
    }
    if (refusal != REFUSAL_NONE) {
        /* the edge has done nothing: the same word once more is another one */
        ecu->control_word = (uint16_t)(word & ~CONTROL_RESET);
        return refusal;
    }
    switch (word & CONTROL_STATE_MASK) {
    case CONTROL_ACTIVE:
        return ecu->mode == MODE_RUN || ecu->mode == MODE_COMMISSION ? REFUSAL_NONE
                                                                     : request_event(ecu, port, EVENT_RUN);
    case CONTROL_HOLD:
        return request_event(ecu, port, EVENT_HOLD);
    case CONTROL_DISABLED:
    case 0u:
        return request_event(ecu, port, EVENT_STANDBY);
    default:
        return REFUSAL_UNKNOWN_REQUEST;
    }
}
