#include "control/observer.h"

/* No joint of any machine is faster, rad/s; an encoder that jumps could otherwise drive the state anywhere. */
#define RATE_LIMIT SCALAR(30)

SELDOM struct observer_constants observer_constants(gain bandwidth, scalar dt_s)
{
    /* rho = exp(-x) by the (2,2) Pade approximant, error below 2e-3 for x <= 1: the pole need not be exact */
    const scalar x = amp(bandwidth, dt_s);
    const scalar even = SCALAR(12) + mul(x, x);
    const scalar rho = quot(even - mul(SCALAR(6), x), even + mul(SCALAR(6), x));
    const scalar rest = SCALAR(1) - rho;
    return (struct observer_constants){
        .correct_error = SCALAR(1) - mul(rho, rho),
        .correct_rate = gain_quot(mul(rest, rest), dt_s),
    };
}

struct observer observer_at(scalar e)
{
    return (struct observer){.e = e};
}

void observer_step(struct observer *observer, const struct observer_constants *constants, scalar e,
                   scalar dt_s)
{
    const scalar predicted = observer->e + mul(dt_s, observer->w);
    const scalar innovation = e - predicted;
    observer->e = predicted + mul(constants->correct_error, innovation);
    observer->w = limit(observer->w + amp(constants->correct_rate, innovation), -RATE_LIMIT, RATE_LIMIT);
}
