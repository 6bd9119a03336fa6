/* PID on the joint angle: the baseline, and nothing else. */
#ifndef CONTROL_PID_H
#define CONTROL_PID_H

#include "control/scalar.h"

struct pid_gains {
    gain kp; /* spool per rad */
    gain ki; /* spool per rad s */
    gain kd; /* spool per rad/s */
};

struct pid {
    scalar integral; /* spool */
};

/* e1 = q - qd in rad, its rate in rad/s; the spool set-point, -1..1. The integral stops at the limit. */
scalar pid_step(struct pid *pid, const struct pid_gains *gains, scalar e1, scalar e1_rate, scalar dt_s);

#endif
