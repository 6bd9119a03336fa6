/* From power-on to main: vector table, memory, FPU. */
#include <stdint.h>

#include "ports/cortex_m/clock.h"
#include "ports/cortex_m/registers.h"
#include "ports/cortex_m/uart.h"

/* Made by the linker script; all are multiples of 4. */
extern uint32_t image_data_begin[], image_data_end[];
extern const uint32_t image_data_initial[];
extern uint32_t image_bss_begin[], image_bss_end[];
extern uint32_t image_stack_end[];

int main(void);
void reset(void);

#define VECTORS 47 /* 15 of the core, 32 of the board */

struct vector_table {
    uint32_t *stack;
    void (*handler[VECTORS])(void);
};

/* A fault, or an interrupt nobody asked for: the software is not what was tested. Nothing is sent and no
 * watchdog is fed from here; the I/O node closes the valves when SYNC stays away. */
static void unexpected(void)
{
    interrupts_disable();
    for (;;) {
    }
}

static const struct vector_table vectors __attribute__((section(".vectors"), used)) = {
    .stack = image_stack_end,
    .handler =
        {
            [0] = reset,
            [1] = unexpected,  /* NMI */
            [2] = unexpected,  /* hard fault */
            [3] = unexpected,  /* memory management */
            [4] = unexpected,  /* bus fault */
            [5] = unexpected,  /* usage fault */
            [10] = unexpected, /* SVC */
            [11] = unexpected, /* debug monitor */
            [13] = unexpected, /* PendSV */
            [14] = clock_interrupt,
            [15 + UART_RX_VECTOR] = uart_rx_interrupt,
            [15 + UART_TX_VECTOR] = uart_tx_interrupt,
        },
};

void reset(void)
{
#if defined(__ARM_FP)
    COPROCESSOR_ACCESS |= COPROCESSOR_ACCESS_FPU;
    barrier();
#endif
    const uint32_t *from = image_data_initial;
    for (uint32_t *to = image_data_begin; to < image_data_end; to++) {
        *to = *from;
        from++;
    }
    for (uint32_t *to = image_bss_begin; to < image_bss_end; to++) {
        *to = 0;
    }
    (void)main();
    unexpected();
}
