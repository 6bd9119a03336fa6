/* The one clock of the Linux port. */
#ifndef PORTS_LINUX_CLOCK_H
#define PORTS_LINUX_CLOCK_H

#include <stdint.h>
#include <time.h>

enum { NS_PER_US = 1000, NS_PER_MS = 1000000, NS_PER_S = 1000000000 };

/* CLOCK_MONOTONIC in ns since an arbitrary start; does not fail on Linux. */
static inline int64_t clock_now_ns(void)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * NS_PER_S + now.tv_nsec;
}

/* The ECU's now_us: CLOCK_MONOTONIC in us, modulo 2^32. The context is not used. */
static inline uint32_t clock_port_now_us(void *context)
{
    (void)context;
    return (uint32_t)(clock_now_ns() / NS_PER_US);
}

#endif
