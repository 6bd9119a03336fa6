/* CAN frames as SLCAN text: t, three hex digits of identifier, one of length, two for each byte, CR. */
#ifndef PORTS_CORTEX_M_SLCAN_TEXT_H
#define PORTS_CORTEX_M_SLCAN_TEXT_H

#include "ecu/port.h"
#include "ports/cortex_m/uart.h"

/* The frame as a line to send. */
void slcan_write_frame(const struct can_frame_11bit *frame, struct uart_line *line);

/* Reads a text without its CR; false when it is not exactly one data frame with an 11 bit identifier. */
bool slcan_read_frame(const uint8_t *text, uint8_t length, struct can_frame_11bit *frame);

#endif
