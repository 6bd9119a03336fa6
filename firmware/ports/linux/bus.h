/* A bus as the Linux port sees it: the ECU's three functions, a descriptor to wait on, and what went wrong.
 * One of socketcan_open and socketcand_open fills it; loop.c and main.c know no more than this. */
#ifndef PORTS_LINUX_BUS_H
#define PORTS_LINUX_BUS_H

#include <stdbool.h>
#include <stdint.h>

#include "ecu/port.h"

enum {
    BUS_MESSAGE_BYTES = 1024,
    BUS_SOCKET_BUFFER_BYTES = 1 << 20 /* some seconds of traffic, for a desktop that pauses this process */
};

enum bus_state {
    BUS_UP,
    BUS_DOWN,   /* the bus or its server is gone; `message` says why */
    BUS_REFUSED /* the server answered with an error; `message` has its words */
};

struct bus_stats {
    uint64_t send_drops;     /* frames the ECU wanted to send and the bus did not take */
    uint64_t receive_errors; /* reads or texts that were no frame */
    uint64_t receive_drops;  /* frames the kernel dropped because the socket buffer was full */
};

struct bus {
    struct ecu_port port; /* port.context is handed to `flush` and `close` too */
    int fd;               /* readable when `port.receive` may have something; never blocks */
    enum bus_state state;
    bool drained; /* the last receive found nothing: only now is it right to wait on `fd` */
    struct bus_stats stats;
    char message[BUS_MESSAGE_BYTES]; /* one line, no newline; valid after a failed open and when not BUS_UP */
    /* Hands what `port.send` collected to the kernel. False: some is left, call again when `fd` takes it. */
    bool (*flush)(void *context);
    /* Hands over what is left, for at most 0.2 s, then closes. False: something could not be handed over. */
    bool (*close)(void *context);
};

#endif
