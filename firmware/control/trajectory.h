/* Point-to-point move of one joint, third-order differentiable: rate, acceleration and jerk are zero at both
 * ends. s(tau) = 35 tau^4 - 84 tau^5 + 70 tau^6 - 20 tau^7, tau = 0..1. */
#ifndef CONTROL_TRAJECTORY_H
#define CONTROL_TRAJECTORY_H

#include "control/scalar.h"

struct trajectory {
    scalar start;    /* rad */
    scalar distance; /* rad */
    gain per_second; /* 1 / duration, 1/s */
    uint32_t ticks;  /* of the whole move; 0 = at rest */
    uint32_t tick;   /* 0..ticks */
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

/* The reference at the present tick. */
struct reference trajectory_now(const struct trajectory *trajectory);

/* One tick further; a finished move becomes rest at its target. */
void trajectory_advance(struct trajectory *trajectory);

#endif
