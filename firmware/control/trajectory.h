/* Point-to-point move of one joint, third-order differentiable: rate, acceleration and jerk are zero at both
 * ends. s(tau) = 35 tau^4 - 84 tau^5 + 70 tau^6 - 20 tau^7, tau = 0..1.
 *
 * A move can be braked: tau then runs ever slower, tau' = sigma / duration, sigma from 1 to 0 along a smooth step,
 * so the joint stays on its path and comes to rest on it with continuous rate and acceleration. */
#ifndef CONTROL_TRAJECTORY_H
#define CONTROL_TRAJECTORY_H

#include "control/scalar.h"

struct trajectory {
    scalar start;         /* rad */
    scalar distance;      /* rad */
    gain per_second;      /* 1 / duration, 1/s */
    uint32_t ticks;       /* of the whole move; 0 = at rest */
    uint32_t tick;        /* 0..ticks */
    scalar tau;           /* while braking; before, tick / ticks */
    uint16_t brake_ticks; /* of the whole brake; 0 = not braking */
    uint16_t brake_tick;
    gain brake_per_second; /* 1 / duration of the brake, 1/s */
};

struct reference {
    scalar q; /* qd, rad */
    scalar w; /* qd', rad/s */
    scalar a; /* qd'', rad/s^2 */
};

/* At rest at q, rad. */
struct trajectory trajectory_at_rest(scalar q);

/* A move from the present end point to target (rad) that takes `ticks` >= 1 ticks of dt_s. Only from rest;
 * false, and nothing changed, while a move is under way or ticks is 0. */
bool trajectory_start(struct trajectory *trajectory, scalar target, uint32_t ticks, scalar dt_s);

bool trajectory_moving(const struct trajectory *trajectory);

/* Bring a move under way to rest on its path within brake_ticks (>= 1) ticks of dt_s; at rest, or braking already,
 * nothing changes. */
void trajectory_brake(struct trajectory *trajectory, uint16_t brake_ticks, scalar dt_s);

/* The reference at the present tick. */
struct reference trajectory_now(const struct trajectory *trajectory);

/* One tick of dt_s further; a finished move becomes rest at its target, a finished brake rest where it ended. */
void trajectory_advance(struct trajectory *trajectory, scalar dt_s);

/* Smooth step down: 1 at 0, 0 at 1, flat at both ends. x: 0..1 */
scalar smooth_step_down(scalar x);

#endif
