#include "control/safe_stop.h"

/* The spool that moves joint i at rate w, when nothing accelerates: Eq 6 with F' = 0. */
static scalar model_spool(const struct machine *machine, const struct controller_constants *constants,
                          const struct measurement *at, enum joint i, scalar w)
{
    const struct cylinder *const cylinder = &machine->cylinder[i];
    const struct cylinder_state state = cylinder_at(cylinder, &constants->cylinder[i], at->q[i]);
    const scalar QL = mul(state.lamA, mul(state.R, w));
    const scalar QL_gain = valve_gain(cylinder, &machine->supply, &state, at->p[i], QL >= SCALAR(0));
    return valve_spool(cylinder, limit(quot(QL, QL_gain), SCALAR(-1), SCALAR(1)));
}

struct safe_stop safe_stop_start(const struct controller *controller, const struct machine *machine,
                                 const struct controller_constants *constants,
                                 const struct measurement *last_good, uint16_t ticks)
{
    struct safe_stop stop = {.ticks = ticks, .at = *last_good};
    for (uint8_t i = 0; i < JOINTS; i++) {
        const struct joint_output *const out = &controller->output[i];
        stop.w[i] = out->reference.w;
        stop.extra[i] = out->u - model_spool(machine, constants, last_good, (enum joint)i, stop.w[i]);
    }
    return stop;
}

bool safe_stop_step(struct safe_stop *stop, const struct machine *machine,
                    const struct controller_constants *constants, scalar u[JOINTS])
{
    if (stop->tick < stop->ticks) {
        stop->tick++;
    }
    const bool over = stop->tick >= stop->ticks;
    const scalar share = smooth_step_down(fraction(stop->tick, stop->ticks));
    for (uint8_t i = 0; i < JOINTS; i++) {
        const scalar spool =
            model_spool(machine, constants, &stop->at, (enum joint)i, mul(share, stop->w[i])) +
            mul(share, stop->extra[i]);
        u[i] = over ? SCALAR(0) : limit(spool, SCALAR(-1), SCALAR(1));
    }
    return over;
}
