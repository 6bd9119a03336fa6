#include "control/scalar.h"

#define PI SCALAR(3.14159265358979323846)
#define HALF_PI SCALAR(1.57079632679489661923)
#define TWO_PI SCALAR(6.28318530717958647692)

scalar sine(scalar x)
{
    if (x > PI) {
        x = x - TWO_PI;
    } else if (x < -PI) {
        x = x + TWO_PI;
    }
    if (x > HALF_PI) {
        x = PI - x;
    } else if (x < -HALF_PI) {
        x = -PI - x;
    }
    return sine_quarter(x);
}

scalar cosine(scalar x)
{
    return sine(x < SCALAR(0) ? HALF_PI + x : HALF_PI - x);
}
