/* A hook for the chip's watchdog. */
#ifndef PORTS_CORTEX_M_WATCHDOG_H
#define PORTS_CORTEX_M_WATCHDOG_H

/* Called from the main loop after every tick, and every period while the bus is closed; never from an
 * interrupt, nor after a fault. The one here does nothing and is weak: define another to feed a watchdog. */
void watchdog_feed(void);

#endif
