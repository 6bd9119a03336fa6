#include "ports/cortex_m/slcan.h"

#include <stddef.h>

#include "ports/cortex_m/measure.h"
#include "ports/cortex_m/slcan_text.h"
#include "ports/cortex_m/uart.h"

#define YES ((uint8_t)'\r')
#define NO ((uint8_t)'\a')
#define VERSION 0x1010u
#define SERIAL_NUMBER 0xD1ACu
#define LINES_A_CALL 64u /* who keeps sending must not hold up the tick */

static struct {
    bool open;
    uint32_t openings;
} channel;

static void answer(uint8_t yes_or_no)
{
    struct uart_line *const line = uart_free_line();
    if (line == NULL) {
        return; /* who asks that much without reading gets no answer */
    }
    line->first = 0;
    line->last = yes_or_no;
    line->digits = 0;
    uart_send();
}

/* The command's own letter and four digits. */
static void answer_number(uint8_t verb, uint16_t number)
{
    struct uart_line *const line = uart_free_line();
    if (line == NULL) {
        return;
    }
    line->first = verb;
    line->last = YES;
    line->digits = 4;
    line->packed[0] = (uint8_t)(number >> 8);
    line->packed[1] = (uint8_t)number;
    uart_send();
}

static void open_channel(void)
{
    if (channel.open) {
        answer(NO);
        return;
    }
    channel.open = true;
    channel.openings++;
    answer(YES);
}

static bool is_bit_rate(const uint8_t *line, uint8_t length)
{
    return length == 2u && line[0] == (uint8_t)'S' && line[1] >= (uint8_t)'0' && line[1] <= (uint8_t)'8';
}

static void command(const uint8_t *line, uint8_t length)
{
    const uint8_t verb = length == 1u ? line[0] : 0u;
    if (verb == (uint8_t)'O') {
        open_channel();
    } else if (verb == (uint8_t)'C') {
        channel.open = false;
        answer(YES);
    } else if (verb == (uint8_t)'V') {
        answer_number(verb, VERSION);
    } else if (verb == (uint8_t)'N') {
        answer_number(verb, SERIAL_NUMBER);
    } else if (length == 0u || (is_bit_rate(line, length) && !channel.open)) {
        answer(YES);
    } else if (!measure_command(verb)) {
        answer(NO);
    }
}

/* True when the line is a frame for the ECU, else it is dealt with. */
static bool take_line(const uint8_t *line, uint8_t length, struct can_frame_11bit *frame)
{
    const uint8_t first = length > 0u ? line[0] : 0u;
    if (channel.open && slcan_read_frame(line, length, frame)) {
        return true;
    }
    if (channel.open && (first == (uint8_t)'T' || first == (uint8_t)'r' || first == (uint8_t)'R')) {
        return false;
    }
    command(line, length);
    return false;
}

enum port_status slcan_receive(void *context, struct can_frame_11bit *frame)
{
    (void)context;
    for (uint32_t n = 0; n < LINES_A_CALL; n++) {
        uint8_t length;
        const uint8_t *const line = uart_received_line(&length);
        if (line == NULL) {
            break;
        }
        const bool is_frame = take_line(line, length, frame);
        uart_release();
        if (is_frame) {
            return PORT_OK;
        }
    }
    return PORT_EMPTY;
}

enum port_status slcan_send(void *context, const struct can_frame_11bit *frame)
{
    (void)context;
    const enum stage before = measure_switch(STAGE_SEND);
    enum port_status status = PORT_DOWN;
    if (channel.open) {
        struct uart_line *const line = uart_free_line();
        status = line != NULL ? PORT_OK : PORT_BUSY;
        if (line != NULL) {
            slcan_write_frame(frame, line);
            uart_send();
        }
    }
    (void)measure_switch(before);
    return status;
}

bool slcan_is_open(void)
{
    return channel.open;
}

uint32_t slcan_openings(void)
{
    return channel.openings;
}
