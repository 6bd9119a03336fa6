/* A CAN interface of the Linux kernel (vcan0, can0) as a bus. */
#ifndef PORTS_LINUX_SOCKETCAN_H
#define PORTS_LINUX_SOCKETCAN_H

#include <linux/can.h>
#include <stdbool.h>
#include <stddef.h>

#include "ports/linux/bus.h"

enum { SOCKETCAN_BATCH_FRAMES = 16 };

struct socketcan {
    struct bus bus; /* first: what the loop sees */
    const char *interface;
    bool is_bus_off; /* the controller's error count has taken it off the bus; it says when it is back */
    size_t received_count; /* in `received` */
    size_t taken_count;    /* of these, already handed over */
    bool read_all;         /* the last read left nothing in the kernel */
    struct can_frame received[SOCKETCAN_BATCH_FRAMES];
    size_t received_bytes[SOCKETCAN_BATCH_FRAMES];
};

/* Opens `interface` for 11 bit data frames and fills *can. False: can->bus.message has one line that says what
 * is missing and the command that helps; nothing is left open. `interface` must outlive the bus.
 *
 * An interface that goes down or bus-off pauses the bus, until it comes up again or its controller is restarted;
 * one that is removed ends it. */
bool socketcan_open(struct socketcan *can, const char *interface);

#endif
