/* A stop that trusts no sensor: the valves' set-points ramp down on the model. The joints' reference rates go to zero
 * along a smooth step, and the spool is set to what the flow equation (Eq 6, steady) says the rate takes,
 *     lamA R w = QL = gain(p) opening
 * at the angles and pressures of the last good sample before the ramp. What the law had asked for beyond that fades
 * with it. */
#ifndef CONTROL_SAFE_STOP_H
#define CONTROL_SAFE_STOP_H

#include "control/controller.h"

struct safe_stop {
    uint16_t ticks; /* of the whole ramp */
    uint16_t tick;
    struct measurement at; /* the last good sample before it */
    scalar w[JOINTS];      /* reference rate at its start, rad/s */
    scalar extra[JOINTS];  /* set-point at its start less the model's, -2..2 */
};

/* From the controller's last outputs, over ticks >= 1. */
struct safe_stop safe_stop_start(const struct controller *controller, const struct machine *machine,
                                 const struct controller_constants *constants,
                                 const struct measurement *last_good, uint16_t ticks);

/* One tick: set-points -1..1. Returns true once the ramp is over, and then u is zero. */
bool safe_stop_step(struct safe_stop *stop, const struct machine *machine,
                    const struct controller_constants *constants, scalar u[JOINTS]);

#endif
