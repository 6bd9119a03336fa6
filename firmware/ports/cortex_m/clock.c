#include "ports/cortex_m/clock.h"

#include "ports/cortex_m/registers.h"

static volatile uint32_t periods;
static uint32_t length_us;

void clock_start(uint32_t period_us)
{
    length_us = period_us;
    SYSTICK_RELOAD = period_us * CLOCK_MHZ - 1u;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = SYSTICK_CONTROL_RUN;
}

void clock_interrupt(void)
{
    periods++;
}

uint32_t clock_periods(void)
{
    return periods;
}

/* The period under way and the cycles into it, from one instant: also while the interrupt that counts the
 * period is still pending. */
static uint32_t read_cycles(uint32_t *period)
{
    uint32_t before;
    uint32_t value;
    do {
        before = periods;
        *period = before;
        value = SYSTICK_VALUE;
        if ((INTERRUPT_STATE & INTERRUPT_STATE_SYSTICK_PENDING) != 0u) {
            *period = before + 1u;
            value = SYSTICK_VALUE;
        }
    } while (before != periods);
    return length_us * CLOCK_MHZ - 1u - value;
}

uint32_t clock_cycles(void)
{
    uint32_t period;
    const uint32_t cycles = read_cycles(&period);
    return period * (length_us * CLOCK_MHZ) + cycles;
}

uint32_t clock_port_now_us(void *context)
{
    (void)context;
    uint32_t period;
    const uint32_t cycles = read_cycles(&period);
    return period * length_us + cycles / CLOCK_MHZ;
}
