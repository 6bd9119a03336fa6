/* CAN frames as SLCAN text: t, three hex digits of identifier, one of length, two for each byte, CR. */
#ifndef PORTS_CORTEX_M_SLCAN_TEXT_H
#define PORTS_CORTEX_M_SLCAN_TEXT_H

#include "ecu/port.h"

enum { SLCAN_FRAME_TEXT_MAX = 22 };

/* Writes the frame's text with its CR; the number of characters. */
uint8_t slcan_write_frame(const struct can_frame_11bit *frame, uint8_t text[SLCAN_FRAME_TEXT_MAX]);

/* Reads a text without its CR; false when it is not exactly one data frame with an 11 bit identifier. */
bool slcan_read_frame(const uint8_t *text, uint8_t length, struct can_frame_11bit *frame);

/* `digits` upper case hexadecimal digits of the value. */
void slcan_write_hex(uint8_t *text, uint32_t value, uint8_t digits);

#endif
