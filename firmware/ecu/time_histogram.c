#include "ecu/time_histogram.h"

void time_histogram_add(struct time_histogram *histogram, uint32_t time_us)
{
    uint8_t bucket = 0;
    for (uint32_t rest = time_us; rest != 0u && bucket < TIME_BUCKETS - 1; rest >>= 1u) {
        bucket++;
    }
    if (histogram->count[bucket] < UINT32_MAX) {
        histogram->count[bucket]++;
    }
}
