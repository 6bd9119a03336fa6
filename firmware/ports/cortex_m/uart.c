#include "ports/cortex_m/uart.h"

#include <stddef.h>

#include "ports/cortex_m/measure.h"
#include "ports/cortex_m/registers.h"

#define RING_LINES 16u /* a power of two; a tick's frames are some 8 */

struct text_line {
    uint8_t text[UART_LINE_BYTES];
    uint8_t length;
};

/* Which lines of a ring are in use. One side only writes `put`, the other only `taken`; both count on and wrap at
 * 2^32. What a line holds is written before `put` counts it and read before `taken` does. */
struct ring {
    volatile uint32_t put;
    volatile uint32_t taken;
};

static struct ring rx; /* put by the interrupt, taken by the main loop */
static struct ring tx; /* put by the main loop, taken by the interrupt */
static struct text_line rx_line[RING_LINES];
static struct uart_line tx_line[RING_LINES];
static volatile uint32_t rx_lines;
static uint8_t rx_length; /* of the line that is coming in */
static uint8_t tx_place;  /* in the line that is going out: 0 its first character, then its digits */

static uint32_t used(const struct ring *ring)
{
    const uint32_t put = ring->put;
    return put - ring->taken;
}

static uint32_t oldest(const struct ring *ring)
{
    return ring->taken % RING_LINES;
}

static uint32_t next(const struct ring *ring)
{
    return ring->put % RING_LINES;
}

void uart_start(void)
{
    UART_DIVIDER = UART_DIVIDER_1_MBAUD;
    UART_CONTROL = UART_CONTROL_RUN;
    NVIC_ENABLE = 1u << UART_RX_VECTOR | 1u << UART_TX_VECTOR;
}

/* A line that is complete; it is lost when the ring is full. */
static void end_line(void)
{
    if (used(&rx) < RING_LINES) {
        rx_line[next(&rx)].length = rx_length;
        memory_barrier();
        rx.put = rx.put + 1u;
    }
    rx_length = 0;
    rx_lines = rx_lines + 1u;
}

void uart_rx_interrupt(void)
{
    const enum stage before = measure_switch(STAGE_UART);
    UART_INTERRUPT = UART_INTERRUPT_RX;
    while ((UART_STATE & UART_STATE_RX_FULL) != 0u) {
        const uint8_t byte = (uint8_t)UART_DATA;
        if (byte == (uint8_t)'\r') {
            end_line();
        } else if (rx_length < UART_LINE_BYTES) {
            if (used(&rx) < RING_LINES) {
                rx_line[next(&rx)].text[rx_length] = byte;
            }
            rx_length++;
        }
    }
    (void)measure_switch(before);
}

static uint8_t character(const struct uart_line *line, uint8_t place)
{
    if (place == 0u) {
        return line->first;
    }
    if (place > line->digits) {
        return line->last;
    }
    const uint8_t pair = line->packed[(place - 1u) / 2u];
    return (uint8_t) "0123456789ABCDEF"[place % 2u != 0u ? pair >> 4 : pair & 0xFu];
}

void uart_tx_interrupt(void)
{
    const enum stage before = measure_switch(STAGE_UART);
    UART_INTERRUPT = UART_INTERRUPT_TX;
    while (used(&tx) > 0u && (UART_STATE & UART_STATE_TX_FULL) == 0u) {
        const struct uart_line *const line = &tx_line[oldest(&tx)];
        tx_place = tx_place == 0u && line->first == 0u ? 1u : tx_place;
        UART_DATA = character(line, tx_place);
        tx_place++;
        if (tx_place > line->digits + 1u) {
            tx_place = 0;
            memory_barrier();
            tx.taken = tx.taken + 1u;
        }
    }
    (void)measure_switch(before);
}

struct uart_line *uart_free_line(void)
{
    return used(&tx) < RING_LINES ? &tx_line[next(&tx)] : NULL;
}

void uart_send(void)
{
    memory_barrier();
    tx.put = tx.put + 1u;
    NVIC_PENDING = 1u << UART_TX_VECTOR; /* the ring is emptied in one place only */
}

const uint8_t *uart_received_line(uint8_t *length)
{
    if (used(&rx) == 0u) {
        return NULL;
    }
    const struct text_line *const line = &rx_line[oldest(&rx)];
    memory_barrier();
    *length = line->length;
    return line->text;
}

void uart_release(void)
{
    memory_barrier();
    rx.taken = rx.taken + 1u;
}

uint32_t uart_lines(void)
{
    return rx_lines;
}
