#include "control/trajectory.h"

struct trajectory trajectory_at_rest(scalar q)
{
    return (struct trajectory){.start = q};
}

bool trajectory_moving(const struct trajectory *trajectory)
{
    return trajectory->ticks != 0u;
}

bool trajectory_start(struct trajectory *trajectory, scalar target, uint32_t ticks, scalar dt_s)
{
    if (trajectory_moving(trajectory) || ticks == 0u || ticks > INT32_MAX) {
        return false;
    }
    trajectory->distance = target - trajectory->start;
    trajectory->ticks = ticks;
    trajectory->tick = 0;
    trajectory->per_tick = quot(SCALAR(1), scalar_from_raw((int32_t)ticks, 0));
    trajectory->per_second = quot(trajectory->per_tick, dt_s);
    return true;
}

struct reference trajectory_now(const struct trajectory *trajectory)
{
    if (!trajectory_moving(trajectory)) {
        return (struct reference){.q = trajectory->start};
    }
    const scalar tau = mul(scalar_from_raw((int32_t)trajectory->tick, 0), trajectory->per_tick);
    const scalar tau2 = mul(tau, tau);
    const scalar tau3 = mul(tau2, tau);
    const scalar rest = SCALAR(1) - tau;
    const scalar rest2 = mul(rest, rest);
    /* s, s' = 140 tau^3 (1 - tau)^3, s'' = 420 tau^2 (1 - tau)^2 (1 - 2 tau) */
    const scalar s =
        mul(mul(tau3, tau), SCALAR(35) + mul(tau, SCALAR(-84) + mul(tau, SCALAR(70) - mul(SCALAR(20), tau))));
    const scalar ds = SCALAR(140) * mul(tau3, mul(rest2, rest));
    const scalar dds = SCALAR(420) * mul(mul(tau2, rest2), SCALAR(1) - SCALAR(2) * tau);
    return (struct reference){
        .q = trajectory->start + mul(trajectory->distance, s),
        .w = amp(trajectory->per_second, mul(trajectory->distance, ds)),
        .a = amp(trajectory->per_second, amp(trajectory->per_second, mul(trajectory->distance, dds))),
    };
}

void trajectory_advance(struct trajectory *trajectory)
{
    if (!trajectory_moving(trajectory)) {
        return;
    }
    trajectory->tick++;
    if (trajectory->tick >= trajectory->ticks) {
        *trajectory = trajectory_at_rest(trajectory->start + trajectory->distance);
    }
}
