/* The text of the socketcand protocol: a streaming parser and the two formats that a client sends.
 * Pure: bytes in, messages out; no sockets, clock or heap. */
#ifndef PORTS_LINUX_SOCKETCAND_TEXT_H
#define PORTS_LINUX_SOCKETCAND_TEXT_H

#include <stdbool.h>
#include <stddef.h>

#include "ecu/port.h"

enum {
    SOCKETCAND_TEXT_BYTES = 200, /* longest accepted text between < and >; a frame needs 60 */
    SOCKETCAND_SEND_BYTES = 40   /* a buffer of this size holds every send command and its final zero */
};

enum socketcand_kind {
    SOCKETCAND_NOTHING,  /* all bytes consumed, no message complete yet */
    SOCKETCAND_HI,       /* < hi > */
    SOCKETCAND_OK,       /* < ok > */
    SOCKETCAND_FRAME,    /* < frame 123 1700000000.123456 0102 >, 11 bit; `frame` is set */
    SOCKETCAND_IGNORED,  /* well formed and not for us: extended frame, FD frame, CAN error frame, echo */
    SOCKETCAND_ERROR,    /* < error words >; `text` has the words */
    SOCKETCAND_MALFORMED /* skipped; to be counted */
};

struct socketcand_message {
    enum socketcand_kind kind;
    struct can_frame_11bit frame;         /* for SOCKETCAND_FRAME */
    char text[SOCKETCAND_TEXT_BYTES + 1]; /* for SOCKETCAND_ERROR, zero-terminated, printable */
};

/* All zero is a parser that has seen nothing. */
struct socketcand_parser {
    enum { SOCKETCAND_OUTSIDE, SOCKETCAND_INSIDE, SOCKETCAND_SKIPPING } place;
    size_t text_bytes;
    char text[SOCKETCAND_TEXT_BYTES + 1];
};

/* Reads `bytes` up to the end of the next message or to their end; gives how many were consumed (0 only for
 * bytes_count 0) and sets *message. Call again with the rest until it says SOCKETCAND_NOTHING: messages may
 * be split and merged anywhere. Text outside < > is one malformed message however long it is. */
size_t socketcand_parse(struct socketcand_parser *parser, const char *bytes, size_t bytes_count,
                        struct socketcand_message *message);

/* Writes "< send 123 2 1 2 >" and a final zero. Gives the length without the zero, or 0 when the frame is not
 * one (id above 0x7FF, length above 8) or `size_bytes` is below SOCKETCAND_SEND_BYTES. */
size_t socketcand_format_send(const struct can_frame_11bit *frame, char *text, size_t size_bytes);

/* Writes "< open CHANNEL >" and a final zero. Gives the length without the zero, 0 when it does not fit. */
size_t socketcand_format_open(const char *channel, char *text, size_t size_bytes);

#endif
