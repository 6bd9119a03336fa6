/* The UART, with a ring of lines in each direction that its interrupts fill and empty. Nothing here waits. */
#ifndef PORTS_CORTEX_M_UART_H
#define PORTS_CORTEX_M_UART_H

#include <stdbool.h>
#include <stdint.h>

/* 8 data bits, no parity, 1 Mbaud. */
void uart_start(void);

#define UART_LINE_BYTES 27u /* of a line, with its carriage return */

/* Where the next line to send may be written, UART_LINE_BYTES at most; NULL when there is no room. */
uint8_t *uart_free_line(void);

/* Sends what was written there. */
void uart_send(uint8_t length);

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
