#include "control/pid.h"

scalar pid_step(struct pid *pid, const struct pid_gains *gains, scalar e1, scalar e1_rate, scalar dt_s)
{
    const scalar integral = pid->integral - mul(dt_s, amp(gains->ki, e1));
    const scalar wanted = integral - amp(gains->kp, e1) - amp(gains->kd, e1_rate);
    const scalar u = limit(wanted, SCALAR(-1), SCALAR(1));
    if (u == wanted) {
        pid->integral = integral;
    }
    return u;
}
