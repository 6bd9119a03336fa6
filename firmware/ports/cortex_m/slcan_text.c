#include "ports/cortex_m/slcan_text.h"

#define ID_DIGITS 3u
#define HEAD 5u /* t, identifier, length */

static uint8_t digit_of(uint32_t value)
{
    return (uint8_t) "0123456789ABCDEF"[value & 0xFu];
}

void slcan_write_hex(uint8_t *text, uint32_t value, uint8_t digits)
{
    for (uint8_t k = digits; k > 0u; k--) {
        text[k - 1u] = digit_of(value);
        value >>= 4;
    }
}

uint8_t slcan_write_frame(const struct can_frame_11bit *frame, uint8_t text[SLCAN_FRAME_TEXT_MAX])
{
    text[0] = (uint8_t)'t';
    text[1] = digit_of(frame->id >> 8);
    text[2] = digit_of(frame->id >> 4);
    text[3] = digit_of(frame->id);
    text[4] = digit_of(frame->length);
    uint8_t *end = &text[HEAD];
    for (uint8_t k = 0; k < frame->length; k++) {
        const uint32_t byte = frame->data[k];
        end[0] = digit_of(byte >> 4);
        end[1] = digit_of(byte);
        end += 2;
    }
    *end = (uint8_t)'\r';
    return (uint8_t)(HEAD + 2u * frame->length + 1u);
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
