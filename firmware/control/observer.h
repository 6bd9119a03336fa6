/* Rate of the tracking error e1 from its samples alone. It runs on e1 and not on q, so that it lags nothing
 * but the error. Critically damped, both poles at -bandwidth; prediction and correction, exact at the
 * sampling instants for an error of constant rate. */
#ifndef CONTROL_OBSERVER_H
#define CONTROL_OBSERVER_H

#include "control/scalar.h"

struct observer_constants {
    scalar correct_error; /* 1 - rho^2, rho = pole per tick */
    gain correct_rate;    /* (1 - rho)^2 / dt, 1/s */
};

struct observer {
    scalar e; /* rad */
    scalar w; /* rad/s */
};

/* bandwidth in rad/s, bandwidth * dt_s < 1. */
struct observer_constants observer_constants(gain bandwidth, scalar dt_s);

/* Start at error e, rad, at rest. */
struct observer observer_at(scalar e);

void observer_step(struct observer *observer, const struct observer_constants *constants, scalar e,
                   scalar dt_s);

#endif
