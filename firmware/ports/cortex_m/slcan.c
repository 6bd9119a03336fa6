#include "ports/cortex_m/slcan.h"

#include <stddef.h>

#include "ports/cortex_m/measure.h"
#include "ports/cortex_m/slcan_text.h"
#include "ports/cortex_m/uart.h"

#define YES "\r"
#define NO "\a"
#define BYTES_A_CALL 512u /* a line that never ends must not hold up the tick */

static struct {
    bool open;
    uint32_t openings;
    uint8_t line[SLCAN_FRAME_TEXT_MAX]; /* what has come since the last CR */
    uint8_t length;                     /* stops at the size of `line`: the line is too long */
} channel;

static void answer(const char *text)
{
    uint8_t length = 0;
    while (text[length] != '\0') {
        length++;
    }
    (void)uart_send((const uint8_t *)text, length); /* who asks that much without reading gets no answer */
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

static bool is_bit_rate(void)
{
    return channel.length == 2u && channel.line[0] == (uint8_t)'S' && channel.line[1] >= (uint8_t)'0' &&
           channel.line[1] <= (uint8_t)'8';
}

static void command(void)
{
    const uint8_t verb = channel.length == 1u ? channel.line[0] : 0u;
    if (verb == (uint8_t)'O') {
        open_channel();
    } else if (verb == (uint8_t)'C') {
        channel.open = false;
        answer(YES);
    } else if (verb == (uint8_t)'V') {
        answer("V1010\r");
    } else if (verb == (uint8_t)'N') {
        answer("NDIAR\r");
    } else if (channel.length == 0u || (is_bit_rate() && !channel.open)) {
        answer(YES);
    } else if (!measure_command(verb)) {
        answer(NO);
    }
}

/* A line is complete: true when it is a frame for the ECU, else it is dealt with. */
static bool take_line(struct can_frame_11bit *frame)
{
    const uint8_t first = channel.length > 0u ? channel.line[0] : 0u;
    if (channel.open && slcan_read_frame(channel.line, channel.length, frame)) {
        return true;
    }
    if (channel.open && (first == (uint8_t)'T' || first == (uint8_t)'r' || first == (uint8_t)'R')) {
        return false;
    }
    command();
    return false;
}

enum port_status slcan_receive(void *context, struct can_frame_11bit *frame)
{
    (void)context;
    uint8_t byte;
    for (uint32_t n = 0; n < BYTES_A_CALL && uart_receive(&byte); n++) {
        if (byte == (uint8_t)'\r') {
            const bool is_frame = take_line(frame);
            channel.length = 0;
            if (is_frame) {
                return PORT_OK;
            }
        } else if (channel.length < sizeof channel.line) {
            channel.line[channel.length] = byte;
            channel.length++;
        }
    }
    return PORT_EMPTY;
}

enum port_status slcan_send(void *context, const struct can_frame_11bit *frame)
{
    (void)context;
    const enum stage before = measure_switch(STAGE_SEND);
    uint8_t text[SLCAN_FRAME_TEXT_MAX];
    const uint8_t length = slcan_write_frame(frame, text);
    const enum port_status status = !channel.open ? PORT_DOWN : uart_send(text, length) ? PORT_OK : PORT_BUSY;
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
