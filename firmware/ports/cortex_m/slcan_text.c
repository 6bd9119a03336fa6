#include "ports/cortex_m/slcan_text.h"

#include "ecu/little_endian.h"

#define ID_DIGITS 3u
#define HEAD 5u /* t, identifier, length */

void slcan_write_frame(const struct can_frame_11bit *frame, struct uart_line *line)
{
    line->first = (uint8_t)'t';
    line->last = (uint8_t)'\r';
    line->digits = (uint8_t)(ID_DIGITS + 1u + 2u * frame->length);
    line->packed[0] = (uint8_t)(frame->id >> 4);
    line->packed[1] = (uint8_t)(frame->id << 4 | frame->length);
    copy_data(&line->packed[2], frame->data);
}

/* False when one of the characters is no digit. */
static bool read_hex(const uint8_t *text, uint8_t digits, uint32_t *value)
{
    *value = 0;
    for (uint8_t k = 0; k < digits; k++) {
        const uint8_t c = text[k];
        uint32_t digit;
        if (c >= (uint8_t)'0' && c <= (uint8_t)'9') {
            digit = (uint32_t)c - (uint8_t)'0';
        } else if (c >= (uint8_t)'A' && c <= (uint8_t)'F') {
            digit = (uint32_t)c - (uint8_t)'A' + 10u;
        } else if (c >= (uint8_t)'a' && c <= (uint8_t)'f') {
            digit = (uint32_t)c - (uint8_t)'a' + 10u;
        } else {
            return false;
        }
        *value = *value << 4 | digit;
    }
    return true;
}

bool slcan_read_frame(const uint8_t *text, uint8_t length, struct can_frame_11bit *frame)
{
    uint32_t id;
    uint32_t bytes;
    if (length < HEAD || text[0] != (uint8_t)'t' || !read_hex(&text[1], ID_DIGITS, &id) || id > 0x7FFu ||
        !read_hex(&text[1u + ID_DIGITS], 1, &bytes) || bytes > 8u || length != HEAD + 2u * bytes) {
        return false;
    }
    *frame = (struct can_frame_11bit){.id = id, .length = (uint8_t)bytes};
    for (uint8_t k = 0; k < frame->length; k++) {
        uint32_t byte;
        if (!read_hex(&text[HEAD + 2u * k], 2, &byte)) {
            return false;
        }
        frame->data[k] = (uint8_t)byte;
    }
    return true;
}
