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
    trajectory->per_second = gain_part(gain_quot(SCALAR(1), dt_s), ticks);
    return true;
}

struct reference trajectory_now(const struct trajectory *trajectory)
{
    if (!trajectory_moving(trajectory)) {
        return (struct reference){.q = trajectory->start};
    }
    const scalar tau = fraction(trajectory->tick, trajectory->ticks);
    const scalar rest = SCALAR(1) - tau;
    const scalar tau2 = mul(tau, tau);
    const scalar rest2 = mul(rest, rest);
    /* s = tau^4 (1 + 4 r + 10 r^2 + 20 r^3), r = 1 - tau: the same polynomial without its large coefficients;
     * s' = 140 tau^3 r^3, s'' = 420 tau^2 r^2 (r - tau) */
    const scalar s = mul(mul(tau2, tau2),
                         SCALAR(1) + mul(rest, SCALAR(4) + mul(rest, SCALAR(10) + mul(SCALAR(20), rest))));
    const scalar ds = amp(GAIN(140), mul(mul(tau2, tau), mul(rest2, rest)));
    const scalar dds = amp(GAIN(420), mul(mul(tau2, rest2), rest - tau));
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
