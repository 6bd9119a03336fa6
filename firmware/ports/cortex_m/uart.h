/* The UART, with a ring of bytes in each direction that its interrupts fill and empty. Nothing here waits. */
#ifndef PORTS_CORTEX_M_UART_H
#define PORTS_CORTEX_M_UART_H

#include <stdbool.h>
#include <stdint.h>

/* 8 data bits, no parity, 1 Mbaud. */
void uart_start(void);

/* Queues all bytes of `text`, or none of them when there is no room: false. */
bool uart_send(const uint8_t *text, uint8_t length);

/* The next byte received; false when there is none. */
bool uart_receive(uint8_t *byte);

/* Carriage returns that have come, received or not; wraps. */
uint32_t uart_lines(void);

/* Run from the interrupts. */
void uart_rx_interrupt(void);
void uart_tx_interrupt(void);

#endif
