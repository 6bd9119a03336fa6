#define _GNU_SOURCE
#include "ports/linux/realtime.h"

#include <sched.h>
#include <stddef.h>
#include <sys/mman.h>

/* Below 50, the priority of the interrupt threads of a PREEMPT_RT kernel: reception depends on them. */
enum { FIFO_PRIORITY = 49, STACK_BYTES = 64 * 1024, PAGE_BYTES = 4096 };

/* Maps the pages of the stack that the ticks will need, before the first tick. */
static void touch_stack(void)
{
    volatile char stack[STACK_BYTES];
    for (size_t i = 0; i < sizeof stack; i += PAGE_BYTES) {
        stack[i] = 0;
    }
}

void realtime_request(bool *has_fifo, bool *has_locked_memory)
{
    const struct sched_param priority = {.sched_priority = FIFO_PRIORITY};
    *has_fifo = sched_setscheduler(0, SCHED_FIFO, &priority) == 0;
    *has_locked_memory = mlockall(MCL_CURRENT | MCL_FUTURE) == 0;
    touch_stack();
}
