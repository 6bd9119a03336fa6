/* The ticks: when each begins, how long it waits for the sensors, and how the run ends. */
#ifndef PORTS_LINUX_LOOP_H
#define PORTS_LINUX_LOOP_H

#include <stdbool.h>
#include <stdint.h>

#include "ecu/ecu.h"
#include "ports/linux/bus.h"

enum pace {
    PACE_REALTIME, /* a timer, and every tick waits for its sensor frames: a slow plant slows the run */
    PACE_STRICT,   /* the timer alone: late frames are lost frames */
    PACE_LOCKSTEP  /* realtime without the timer */
};

/* realtime, strict or lockstep. */
const char *pace_name(enum pace pace);

struct loop_stats {
    uint64_t ticks;         /* ticks begun */
    uint64_t late_ticks;    /* ticks that could not begin on the timer; strict: periods without a tick */
    uint64_t stalled_ticks; /* ticks that ended at their deadline without all sensor frames */
    struct time_histogram start_times; /* of each tick, after the time it was due; none in lockstep */
    bool shutdown_sent;                /* at the end the bus took the valve frame with zero and disabled */
};

enum loop_end {
    LOOP_STOPPED,  /* SIGINT, SIGTERM or SIGHUP; see shutdown_sent and bus->state */
    LOOP_BUS_DOWN, /* bus->state and bus->message say why */
    LOOP_FAILED    /* no timer, signal or epoll descriptor: errno says why; no tick was run */
};

/* Runs the ticks of `ecu` on `bus`, which is up, every `period_us` (250..20000) until a signal or the bus
 * ends it. The first signal is a safe stop: the ticks go on until the valves are shut, 1 s at most. The second
 * ends them at once. Either way the last frame shuts the valves. From here on the process holds the three
 * signals back. */
enum loop_end loop_run(enum pace pace, uint32_t period_us, struct ecu *ecu, struct bus *bus,
                       struct loop_stats *stats);

#endif
