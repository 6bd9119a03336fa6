#include "ecu/time_histogram.h"

void time_histogram_add(struct time_histogram *histogram, uint32_t time_us)
{
    /* as many as the time has binary digits */
    uint8_t bucket = time_us == 0u ? 0u : (uint8_t)(32 - __builtin_clz(time_us));
    if (bucket >= TIME_BUCKETS) {
        bucket = TIME_BUCKETS - 1;
    }
    if (histogram->count[bucket] < UINT32_MAX) {
        histogram->count[bucket]++;
    }
}
