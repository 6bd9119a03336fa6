/* Whole numbers in bytes, least significant first, as images, slots and SDO carry them. */
#ifndef ECU_LITTLE_ENDIAN_H
#define ECU_LITTLE_ENDIAN_H

#include <stdint.h>

/* Made of more operations than are left of it: no compiler that counts them first puts it in place by itself. */
#define IN_PLACE static inline __attribute__((always_inline))

IN_PLACE uint32_t get_u32(const uint8_t *bytes)
{
    return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

IN_PLACE void put_u32(uint8_t *bytes, uint32_t value)
{
    bytes[0] = (uint8_t)value; /* no loop: compilers make one store of it */
    bytes[1] = (uint8_t)(value >> 8);
    bytes[2] = (uint8_t)(value >> 16);
    bytes[3] = (uint8_t)(value >> 24);
}

/* The data of a frame, by words. */
IN_PLACE void copy_data(uint8_t to[8], const uint8_t from[8])
{
    const uint32_t first = get_u32(from);
    const uint32_t last = get_u32(&from[4]);
    put_u32(to, first);
    put_u32(&to[4], last);
}

#endif
