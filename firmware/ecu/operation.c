#include "ecu/operation.h"

#include "ecu/ecu.h"
#include "ecu/samples.h"
#include "ecu/supervision.h"

static struct mode_conditions conditions_of(const struct ecu *ecu)
{
    return (struct mode_conditions){
        .operational = ecu->nmt == NMT_OPERATIONAL,
        .sensors_good = ecu->sampled && ecu->supervision.sensors_wrong == 0u,
        .fault_active = fault_stops(ecu),
        .cause_gone = !parameter_set_coming(ecu) && supervision_cause_gone(ecu),
    };
}

static void arm(struct ecu *ecu, bool commissioning)
{
    struct estimator *const estimator = &ecu->controller.estimator;
    if (commissioning) {
        estimator_commission(estimator);
    } else if (estimator->commissioning) {
        estimator_operate(estimator, &ecu->machine.estimator, &ecu->constants.estimator);
    } else {
        /* the estimate of the last run goes on */
    }
    const struct measurement measured = samples_measured(ecu, &ecu->samples);
    controller_arm(&ecu->controller, ecu->requested_controller, measured.q);
    supervision_arm(ecu, &measured);
}

/* From here on an angle is not held against the one before: what is wrong with a sensor must not get into an estimate
 * that the next run begins with, so its filters, still open from the motion, are emptied. */
static void disarm(struct ecu *ecu)
{
    controller_disarm(&ecu->controller);
    controller_gap(&ecu->controller);
}

static void brake(struct ecu *ecu)
{
    for (uint8_t i = 0; i < JOINTS; i++) {
        trajectory_brake(&ecu->controller.trajectory[i], ecu->supervision.stop_ticks, ecu->constants.dt_s);
    }
}

static void start_safe_stop(struct ecu *ecu)
{
    const struct measurement measured = samples_measured(ecu, &ecu->samples);
    ecu->stop = safe_stop_start(&ecu->controller, &ecu->machine, &ecu->constants, &measured,
                                ecu->supervision.stop_ticks);
    disarm(ecu);
}

static void enter(struct ecu *ecu, enum ecu_mode from, enum ecu_mode to)
{
    const bool from_rest = !mode_drives(from);
    switch (to) {
    case MODE_RUN:
        if (from_rest) {
            arm(ecu, false);
        }
        break;
    case MODE_COMMISSION:
        arm(ecu, true);
        break;
    case MODE_HOLD:
        if (from_rest) {
            arm(ecu, false);
        } else {
            brake(ecu);
        }
        break;
    case MODE_SAFE_STOP:
        start_safe_stop(ecu);
        break;
    case MODE_TARE:
        tare_start(&ecu->tare, ecu->period_us);
        break;
    case MODE_INIT:
    case MODE_STANDBY:
    case MODE_FAULT:
    default:
        disarm(ecu);
        break;
    }
}

enum ecu_refusal operation_event(struct ecu *ecu, enum ecu_event event)
{
    if (event == EVENT_SENSORS_READY && ecu->mode != MODE_INIT) {
        return REFUSAL_NONE; /* comes every tick, and one mode only waits for it: not worth the table's time */
    }
    const struct mode_conditions conditions = conditions_of(ecu);
    const enum ecu_mode from = ecu->mode;
    enum ecu_mode to = from;
    const enum ecu_refusal refusal = modes_next(from, event, &conditions, &to);
    if (refusal == REFUSAL_NONE && to != from) {
        ecu->mode = to;
        enter(ecu, from, to);
    }
    return refusal;
}

void operation_step(struct ecu *ecu)
{
    if (ecu->mode != MODE_SAFE_STOP) {
        return;
    }
    scalar u[JOINTS];
    const bool over = safe_stop_step(&ecu->stop, &ecu->machine, &ecu->constants, u);
    for (uint8_t i = 0; i < JOINTS; i++) {
        ecu->controller.output[i].u = u[i];
    }
    if (over) {
        (void)operation_event(ecu, EVENT_STOPPED);
    }
}
