#include "control/trajectory.h"

struct trajectory trajectory_at_rest(scalar q)
{
    return (struct trajectory){.start = q};
}

bool trajectory_moving(const struct trajectory *trajectory)
{
    return trajectory->ticks != 0u;
}

SELDOM bool trajectory_start(struct trajectory *trajectory, scalar target, uint32_t ticks, scalar dt_s)
{
    if (trajectory_moving(trajectory) || ticks == 0u || ticks > INT32_MAX) {
        return false;
    }
    trajectory->distance = target - trajectory->start;
    trajectory->ticks = ticks;
    trajectory->tick = 0;
    trajectory->brake_ticks = 0;
    trajectory->per_second = gain_part(gain_quot(SCALAR(1), dt_s), ticks);
    return true;
}

scalar smooth_step_down(scalar x)
{
    return SCALAR(1) - mul(mul(x, x), SCALAR(3) - mul(SCALAR(2), x));
}

static bool braking(const struct trajectory *trajectory)
{
    return trajectory->brake_ticks != 0u;
}

SELDOM void trajectory_brake(struct trajectory *trajectory, uint16_t brake_ticks, scalar dt_s)
{
    if (!trajectory_moving(trajectory) || braking(trajectory) || brake_ticks == 0u) {
        return;
    }
    trajectory->tau = fraction(trajectory->tick, trajectory->ticks);
    trajectory->brake_ticks = brake_ticks;
    trajectory->brake_tick = 0;
    trajectory->brake_per_second = gain_part(gain_quot(SCALAR(1), dt_s), brake_ticks);
}

struct reference trajectory_now(const struct trajectory *trajectory)
{
    if (!trajectory_moving(trajectory)) {
        return (struct reference){.q = trajectory->start};
    }
    const scalar tau = braking(trajectory) ? trajectory->tau : fraction(trajectory->tick, trajectory->ticks);
    const scalar rest = SCALAR(1) - tau;
    const scalar tau2 = mul(tau, tau);
    const scalar rest2 = mul(rest, rest);
    /* s = tau^4 (1 + 4 r + 10 r^2 + 20 r^3), r = 1 - tau: the same polynomial without its large coefficients;
     * s' = 140 tau^3 r^3, s'' = 420 tau^2 r^2 (r - tau) */
    const scalar s = mul(mul(tau2, tau2),
                         SCALAR(1) + mul(rest, SCALAR(4) + mul(rest, SCALAR(10) + mul(SCALAR(20), rest))));
    const scalar ds = amp(GAIN(140), mul(mul(tau2, tau), mul(rest2, rest)));
    const scalar dds = amp(GAIN(420), mul(mul(tau2, rest2), rest - tau));
    struct reference reference = {
        .q = trajectory->start + mul(trajectory->distance, s),
        .w = amp(trajectory->per_second, mul(trajectory->distance, ds)),
        .a = amp(trajectory->per_second, amp(trajectory->per_second, mul(trajectory->distance, dds))),
    };
    if (braking(trajectory)) {
        /* tau' = sigma / T: w = sigma w0, a = sigma^2 a0 + sigma' w0, sigma' = -6 x (1 - x) / T_brake */
        const scalar x = fraction(trajectory->brake_tick, trajectory->brake_ticks);
        const scalar sigma = smooth_step_down(x);
        const scalar slope = mul(SCALAR(6), mul(x, SCALAR(1) - x));
        reference.a =
            mul(mul(sigma, sigma), reference.a) - amp(trajectory->brake_per_second, mul(slope, reference.w));
        reference.w = mul(sigma, reference.w);
    }
    return reference;
}

/* One tick of a brake: tau by the mean of sigma over the tick. */
static void brake_advance(struct trajectory *trajectory, scalar dt_s)
{
    const uint32_t halves = 2u * (uint32_t)trajectory->brake_ticks;
    const scalar middle = fraction(2u * (uint32_t)trajectory->brake_tick + 1u, halves);
    trajectory->tau += amp(trajectory->per_second, mul(dt_s, smooth_step_down(middle)));
    trajectory->brake_tick++;
    if (trajectory->tau >= SCALAR(1)) {
        *trajectory = trajectory_at_rest(trajectory->start + trajectory->distance);
    } else if (trajectory->brake_tick >= trajectory->brake_ticks) {
        *trajectory = trajectory_at_rest(trajectory_now(trajectory).q);
    } else {
        /* the brake goes on */
    }
}

void trajectory_advance(struct trajectory *trajectory, scalar dt_s)
{
    if (!trajectory_moving(trajectory)) {
        return;
    }
    if (braking(trajectory)) {
        brake_advance(trajectory, dt_s);
        return;
    }
    trajectory->tick++;
    if (trajectory->tick >= trajectory->ticks) {
        *trajectory = trajectory_at_rest(trajectory->start + trajectory->distance);
    }
}
