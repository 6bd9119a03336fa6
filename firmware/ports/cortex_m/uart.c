#include "ports/cortex_m/uart.h"

#include <stddef.h>

#include "ports/cortex_m/measure.h"
#include "ports/cortex_m/registers.h"

#define RING_LINES 16u /* a power of two; a tick's frames are some 8 */

struct line {
    uint8_t text[UART_LINE_BYTES];
    uint8_t length;
};

/* One side only writes `put`, the other only `taken`; both count on and wrap at 2^32. What a line holds is written
 * before `put` counts it and read before `taken` does. */
struct ring {
    struct line line[RING_LINES];
    volatile uint32_t put;
    volatile uint32_t taken;
};

static struct ring rx; /* put by the interrupt, taken by the main loop */
static struct ring tx; /* put by the main loop, taken by the interrupt */
static volatile uint32_t rx_lines;
static uint8_t rx_length; /* of the line that is coming in */
static uint8_t tx_sent;   /* of the line that is going out */

static uint32_t used(const struct ring *ring)
{
    const uint32_t put = ring->put;
    return put - ring->taken;
}

static struct line *oldest(struct ring *ring)
{
    return &ring->line[ring->taken % RING_LINES];
}

static struct line *next(struct ring *ring)
{
    return &ring->line[ring->put % RING_LINES];
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
        next(&rx)->length = rx_length;
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
                next(&rx)->text[rx_length] = byte;
            }
            rx_length++;
        }
    }
    (void)measure_switch(before);
}

void uart_tx_interrupt(void)
{
    const enum stage before = measure_switch(STAGE_UART);
    UART_INTERRUPT = UART_INTERRUPT_TX;
    while (used(&tx) > 0u && (UART_STATE & UART_STATE_TX_FULL) == 0u) {
        const struct line *const line = oldest(&tx);
        UART_DATA = line->text[tx_sent];
        tx_sent++;
        if (tx_sent == line->length) {
            tx_sent = 0;
            memory_barrier();
            tx.taken = tx.taken + 1u;
        }
    }
    (void)measure_switch(before);
}

uint8_t *uart_free_line(void)
{
    return used(&tx) < RING_LINES ? next(&tx)->text : NULL;
}

void uart_send(uint8_t length)
{
    next(&tx)->length = length;
    memory_barrier();
    tx.put = tx.put + 1u;
    NVIC_PENDING = 1u << UART_TX_VECTOR; /* the ring is emptied in one place only */
}

const uint8_t *uart_received_line(uint8_t *length)
{
    if (used(&rx) == 0u) {
        return NULL;
    }
    const struct line *const line = oldest(&rx);
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
