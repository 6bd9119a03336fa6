/* Copies go by words where both ends are aligned, as structs are. Built with -fno-tree-loop-distribute-
 * patterns, lest the compiler turn these loops into calls of themselves. */
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#undef memcpy
#undef memset

/* Words that may alias any object. */
typedef uint32_t __attribute__((may_alias)) word;

static bool aligned(const void *pointer)
{
    return (uintptr_t)pointer % sizeof(word) == 0u;
}

void *memcpy(void *restrict to, const void *restrict from, size_t count)
{
    uint8_t *t = to;
    const uint8_t *f = from;
    if (aligned(to) && aligned(from)) {
        for (; count >= sizeof(word); count -= sizeof(word)) {
            *(word *)(void *)t = *(const word *)(const void *)f;
            t += sizeof(word);
            f += sizeof(word);
        }
    }
    for (; count > 0u; count--) {
        *t++ = *f++;
    }
    return to;
}

void *memmove(void *to, const void *from, size_t count)
{
    uint8_t *const t = to;
    const uint8_t *const f = from;
    if ((uintptr_t)t <= (uintptr_t)f) {
        for (size_t k = 0; k < count; k++) {
            t[k] = f[k];
        }
    } else {
        for (size_t k = count; k > 0u; k--) {
            t[k - 1u] = f[k - 1u];
        }
    }
    return to;
}

void *memset(void *to, int value, size_t count)
{
    const uint8_t byte = (uint8_t)value;
    uint8_t *t = to;
    for (; count > 0u && !aligned(t); count--) {
        *t++ = byte;
    }
    if (count > 0u) {
        const word bytes = (word)byte * 0x01010101u;
        /* eight at a time: a reset clears more than 1 kB within a tick */
        for (; count >= 8u * sizeof(word); count -= 8u * sizeof(word)) {
            word *const w = (word *)(void *)t;
            w[0] = bytes;
            w[1] = bytes;
            w[2] = bytes;
            w[3] = bytes;
            w[4] = bytes;
            w[5] = bytes;
            w[6] = bytes;
            w[7] = bytes;
            t += 8u * sizeof(word);
        }
        for (; count >= sizeof(word); count -= sizeof(word)) {
            *(word *)(void *)t = bytes;
            t += sizeof(word);
        }
    }
    for (; count > 0u; count--) {
        *t++ = byte;
    }
    return to;
}

int memcmp(const void *a, const void *b, size_t count)
{
    const uint8_t *const x = a;
    const uint8_t *const y = b;
    for (size_t k = 0; k < count; k++) {
        if (x[k] != y[k]) {
            return x[k] < y[k] ? -1 : 1;
        }
    }
    return 0;
}
