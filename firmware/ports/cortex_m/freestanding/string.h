/* The four functions that a compiler may call on its own, for a toolchain without a C library. */
#ifndef PORTS_CORTEX_M_FREESTANDING_STRING_H
#define PORTS_CORTEX_M_FREESTANDING_STRING_H

#include <stddef.h>

void *memcpy(void *restrict to, const void *restrict from, size_t count);
void *memmove(void *to, const void *from, size_t count);
void *memset(void *to, int value, size_t count);
int memcmp(const void *a, const void *b, size_t count);

/* Said to a compiler of a freestanding program, which else takes them for functions as any other: that what has a small
 * constant size is better done in place. */
#define memcpy(to, from, count) __builtin_memcpy((to), (from), (count))
#define memset(to, value, count) __builtin_memset((to), (value), (count))

#endif
