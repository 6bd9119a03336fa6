/* What a desktop Linux grants towards real time, for paces with a timer. */
#ifndef PORTS_LINUX_REALTIME_H
#define PORTS_LINUX_REALTIME_H

#include <stdbool.h>

/* Asks for SCHED_FIFO and for memory that is never paged out, and says which was granted. The program works
 * without them: ticks may be late then. */
void realtime_request(bool *has_fifo, bool *has_locked_memory);

#endif
