#include "ports/cortex_m/uart.h"

#include "ports/cortex_m/measure.h"
#include "ports/cortex_m/registers.h"

#define RING_BYTES 512u /* a power of two; a tick's frames take at most some 200 */

/* One side only writes `put`, the other only `taken`; both count on and wrap at 2^32. */
struct ring {
    volatile uint8_t byte[RING_BYTES];
    volatile uint32_t put;
    volatile uint32_t taken;
};

static struct ring rx; /* put by the interrupt, taken by the main loop */
static struct ring tx; /* put by the main loop, taken by the interrupt */
static volatile uint32_t rx_lines;

static uint32_t used(const struct ring *ring)
{
    const uint32_t put = ring->put;
    return put - ring->taken;
}

static void put(struct ring *ring, uint8_t byte)
{
    ring->byte[ring->put % RING_BYTES] = byte;
    ring->put = ring->put + 1u;
}

static uint8_t take(struct ring *ring)
{
    const uint8_t byte = ring->byte[ring->taken % RING_BYTES];
    ring->taken = ring->taken + 1u;
    return byte;
}

void uart_start(void)
{
    UART_DIVIDER = UART_DIVIDER_1_MBAUD;
    UART_CONTROL = UART_CONTROL_RUN;
    NVIC_ENABLE = 1u << UART_RX_VECTOR | 1u << UART_TX_VECTOR;
}

void uart_rx_interrupt(void)
{
    const enum stage before = measure_switch(STAGE_UART);
    UART_INTERRUPT = UART_INTERRUPT_RX;
    while ((UART_STATE & UART_STATE_RX_FULL) != 0u) {
        const uint8_t byte = (uint8_t)UART_DATA;
        if (used(&rx) < RING_BYTES) {
            put(&rx, byte); /* else it is lost, and with it the line that it is part of */
        }
        if (byte == (uint8_t)'\r') {
            rx_lines = rx_lines + 1u;
        }
    }
    (void)measure_switch(before);
}

void uart_tx_interrupt(void)
{
    const enum stage before = measure_switch(STAGE_UART);
    UART_INTERRUPT = UART_INTERRUPT_TX;
    while (used(&tx) > 0u && (UART_STATE & UART_STATE_TX_FULL) == 0u) {
        UART_DATA = take(&tx);
    }
    (void)measure_switch(before);
}

bool uart_send(const uint8_t *text, uint8_t length)
{
    if (RING_BYTES - used(&tx) < length) {
        return false;
    }
    for (uint8_t k = 0; k < length; k++) {
        put(&tx, text[k]);
    }
    NVIC_PENDING = 1u << UART_TX_VECTOR; /* the ring is emptied in one place only */
    return true;
}

bool uart_receive(uint8_t *byte)
{
    if (used(&rx) == 0u) {
        return false;
    }
    *byte = take(&rx);
    return true;
}

uint32_t uart_lines(void)
{
    return rx_lines;
}
