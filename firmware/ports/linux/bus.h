/* A bus as the Linux port sees it: the ECU's three functions, its socket, and what went wrong.
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
    BUS_PAUSED, /* no frames pass just now; `message` says why. `port.send` and `port.receive` notice the end */
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
    int fd;
    enum bus_state state;
    bool
        may_wait; /* the next read waits for frames, until the socket's SO_RCVTIMEO or a signal; then false */
    bool drained; /* the last receive found nothing */
    int64_t came_ns; /* when the frames that were read last came; 0: something was sent since */
    struct bus_stats stats;
    char message
        [BUS_MESSAGE_BYTES]; /* one line, no newline; valid after a failed open or a change of `state` */
    /* Hands what `port.send` collected to the kernel. False: some is left, call again when `fd` takes it. */
    bool (*flush)(void *context);
    /* Hands over what is left, for at most 0.2 s, then closes. False: something could not be handed over. */
    bool (*close)(void *context);
};

/* The ECU's now_us, with the struct bus as context: us, modulo 2^32. From a read until the next frame is sent it
 * stands still at the time that the kernel gave the frame read last. So a tick's time begins when its last sensor
 * frame came, however late this process ran, and no clock is read between that frame and the valve frame. */
uint32_t bus_now_us(void *context);

/* The time the kernel gave a message that was received with SO_TIMESTAMPNS; if none, now. */
struct msghdr;
int64_t bus_message_time_ns(struct msghdr *header);

#endif
