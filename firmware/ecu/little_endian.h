/* Whole numbers in bytes, least significant first, as images, slots and SDO carry them. */
#ifndef ECU_LITTLE_ENDIAN_H
#define ECU_LITTLE_ENDIAN_H

#include <stdint.h>

static inline uint32_t get_u32(const uint8_t *bytes)
{
    return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static inline void put_u32(uint8_t *bytes, uint32_t value)
{
    for (uint8_t k = 0; k < 4u; k++) {
        bytes[k] = (uint8_t)(value >> (8u * k));
    }
}

#endif
