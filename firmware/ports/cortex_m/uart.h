/* The UART, with a ring of lines in each direction that its interrupts fill and empty. Nothing here waits. */
#ifndef PORTS_CORTEX_M_UART_H
#define PORTS_CORTEX_M_UART_H

#include <stdbool.h>
#include <stdint.h>

/* 8 data bits, no parity, 1 Mbaud. */
void uart_start(void);

#define UART_DIGIT_BYTES 13u

/* A line to send: one character, hexadecimal digits, one character. The ring keeps the digits packed, and the
 * interrupt makes text of them: half the memory, and nobody waits for a CAN frame to become text. */
struct uart_line {
    uint8_t first; /* 0: there is none */
    uint8_t last;
    uint8_t digits;                   /* 2 UART_DIGIT_BYTES at most */
    uint8_t packed[UART_DIGIT_BYTES]; /* two digits each, the first one in the upper half */
};

/* Where the next line to send may be written; NULL when there is no room. */
struct uart_line *uart_free_line(void);

/* Sends what was written there. */
void uart_send(void);

#define UART_LINE_BYTES 27u /* of a line received, with its carriage return */

/* The oldest line received, without its carriage return, and its length: UART_LINE_BYTES for all that are too long. It
 * stays until uart_release. NULL when there is none. */
const uint8_t *uart_received_line(uint8_t *length);
void uart_release(void);

/* Carriage returns that have come, received or not; wraps. */
uint32_t uart_lines(void);

/* Run from the interrupts. */
void uart_rx_interrupt(void);
void uart_tx_interrupt(void);

#endif
