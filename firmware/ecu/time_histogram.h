/* How often a time fell into which power of two: 0 is below 1 us, n is 2^(n-1) us to below 2^n us, and the
 * last is all from 1024 us on. */
#ifndef ECU_TIME_HISTOGRAM_H
#define ECU_TIME_HISTOGRAM_H

#include <stdint.h>

#define TIME_BUCKETS 12

struct time_histogram {
    uint32_t count[TIME_BUCKETS]; /* each stops at 2^32 - 1 */
};

void time_histogram_add(struct time_histogram *histogram, uint32_t time_us);

#endif
