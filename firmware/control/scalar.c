#include "control/scalar.h"

#define PI SCALAR(3.14159265358979323846)
#define HALF_PI SCALAR(1.57079632679489661923)
#define TWO_PI SCALAR(6.28318530717958647692)

struct sine_cosine sine_cosine(scalar x)
{
    if (x > PI) {
        x = x - TWO_PI;
    } else if (x < -PI) {
        x = x + TWO_PI;
    }
    const scalar a = absolute(x);
    const scalar s = sine_quarter(a > HALF_PI ? PI - a : a);
    return (struct sine_cosine){.s = x < SCALAR(0) ? -s : s, .c = sine_quarter(HALF_PI - a)};
}

scalar sine(scalar x)
{
    return sine_cosine(x).s;
}

scalar cosine(scalar x)
{
    return sine_cosine(x).c;
}
