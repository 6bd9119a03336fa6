/* A bus behind a socketcand server over TCP, lossless: the plant's hub, or a daemon with an adapter. */
#ifndef PORTS_LINUX_SOCKETCAND_CLIENT_H
#define PORTS_LINUX_SOCKETCAND_CLIENT_H

#include <stdbool.h>
#include <stddef.h>

#include "ports/linux/bus.h"
#include "ports/linux/socketcand_text.h"

enum {
    SOCKETCAND_RECEIVE_BYTES = 16 * 1024,
    SOCKETCAND_TRANSMIT_BYTES = 64 * 1024,
    SOCKETCAND_NAME_BYTES = 300
};

struct socketcand_client {
    struct bus bus;                   /* first: what the loop sees */
    char name[SOCKETCAND_NAME_BYTES]; /* HOST:PORT, for messages */
    struct socketcand_parser parser;
    size_t received_bytes; /* in `received` */
    size_t parsed_bytes;   /* of these, already parsed */
    bool collects;         /* something was sent since the last read: more is sent with the next flush */
    bool read_all;         /* the last read left nothing in the kernel */
    size_t queued_bytes;   /* in `transmit` */
    size_t sent_bytes;     /* of these, already with the kernel */
    char received[SOCKETCAND_RECEIVE_BYTES];
    char transmit[SOCKETCAND_TRANSMIT_BYTES];
};

/* Connects, trying for 10 s, and opens `channel` (a name such as vcan0) in raw mode, 3 s per answer. Says
 * once on stderr that it waits. False: client->bus.message has one line; nothing is left open. */
bool socketcand_open(struct socketcand_client *client, const char *host, const char *port,
                     const char *channel);

#endif
