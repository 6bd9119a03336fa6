/* SysTick: the ECU's timer and the one clock of this port. */
#ifndef PORTS_CORTEX_M_CLOCK_H
#define PORTS_CORTEX_M_CLOCK_H

#include <stdint.h>

/* An interrupt every `period_us` from now on. */
void clock_start(uint32_t period_us);

/* Periods since the start; wraps at 2^32. */
uint32_t clock_periods(void);

/* Processor cycles since the start; wraps at 2^32. */
uint32_t clock_cycles(void);

/* The ECU's now_us; the context is not used. Wraps at 2^32. */
uint32_t clock_port_now_us(void *context);

/* Runs from the interrupt. */
void clock_interrupt(void);

#endif
