/* What a machine must not exceed, per unit: the limits of the supervision and the ramp of a safe stop. The list with
 * units and ranges is can_protocol/parameters.toml, what follows from each can_protocol/faults.toml. */
#ifndef CONTROL_LIMITS_H
#define CONTROL_LIMITS_H

#include "control/arm_model.h"

struct limits {
    scalar sensor_wrong_ticks;
    scalar rate[JOINTS];   /* rad/s */
    scalar pressure_step;  /* Pa within 1 ms, or a tick if that is shorter */
    scalar pressure_range; /* Pa */
    scalar angle_range;    /* rad outside the joint's range */
    scalar stuck_travel;   /* rad */
    scalar stuck_s;
    scalar mismatch_updates;
    scalar contradiction; /* rad/s */
    scalar spool_error;   /* of full travel */
    scalar angle_margin;  /* rad */
    scalar pressure_max;  /* Pa */
    scalar pressure_min;  /* Pa */
    scalar persist_s;
    scalar tracking_error; /* rad */
    scalar saturation_s;
    scalar bound_s;
    scalar late_ticks;
    scalar send_ticks;
    scalar stop_s;
};

#endif
