/* The whole platform, as the ECU sees it: three functions and, where there is one, a memory for parameters. Linux,
 * the in-process library and a microcontroller are ports of the same ECU; nothing else of the machine reaches ecu/
 * or control/. */
#ifndef ECU_PORT_H
#define ECU_PORT_H

#include <stdbool.h>
#include <stdint.h>

/* A classic CAN data frame with an 11 bit identifier. */
struct can_frame_11bit {
    uint32_t id;     /* 0..0x7FF */
    uint8_t length;  /* 0..8 */
    uint8_t data[8]; /* bytes past `length` are zero */
};

enum port_status {
    PORT_OK,    /* sent, or a frame was received */
    PORT_EMPTY, /* receive: nothing waits */
    PORT_BUSY,  /* send: the queue is full, the frame was not taken; it is counted, never retried late */
    PORT_DOWN   /* the bus is gone; the port's owner decides what follows */
};

struct store_port;      /* ecu/store.h */
struct parameter_image; /* ecu/parameters.h */

struct ecu_port {
    void *context; /* handed to every function below */
    /* Both never block. */
    enum port_status (*send)(void *context, const struct can_frame_11bit *frame);
    enum port_status (*receive)(void *context, struct can_frame_11bit *frame);
    /* Monotonic time in us; wraps at 2^32. Used for the timing figures only, never by the law. */
    uint32_t (*now_us)(void *context);
    /* Where parameters survive power-off; NULL: they do not, and saving is refused. */
    const struct store_port *store;
    /* What it starts with when nothing is stored; NULL: what is built in. */
    const struct parameter_image *fallback;
};

#endif
