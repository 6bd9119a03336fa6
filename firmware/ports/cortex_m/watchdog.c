#include "ports/cortex_m/watchdog.h"

__attribute__((weak)) void watchdog_feed(void)
{
}
