/* Images of parameters, byte by byte: 12 bytes of header, the numbers, CRC-32. For unit tests and fuzzing. */
#ifndef TESTS_PARAMETER_IMAGES_H
#define TESTS_PARAMETER_IMAGES_H

#include <stdint.h>

#include "ecu/parameters.h"

#define IMAGE_HEADER_BYTES 12u

static inline uint32_t image_u32(const struct parameter_image *image, uint32_t offset)
{
    const uint8_t *const b = &image->bytes[offset];
    return (uint32_t)b[0] | (uint32_t)b[1] << 8 | (uint32_t)b[2] << 16 | (uint32_t)b[3] << 24;
}

static inline void image_set_u32(struct parameter_image *image, uint32_t offset, uint32_t value)
{
    for (uint32_t k = 0; k < 4u; k++) {
        image->bytes[offset + k] = (uint8_t)(value >> (8u * k));
    }
}

/* Make the CRC right again, by the textbook's bitwise CRC-32. */
static inline void image_seal(struct parameter_image *image)
{
    uint32_t crc = UINT32_MAX;
    for (uint32_t k = 0; k < PARAMETER_IMAGE_BYTES - 4u; k++) {
        crc ^= image->bytes[k];
        for (int bit = 0; bit < 8; bit++) {
            crc = (crc & 1u) != 0u ? (crc >> 1) ^ 0xEDB88320u : crc >> 1;
        }
    }
    image_set_u32(image, PARAMETER_IMAGE_BYTES - 4u, ~crc);
}

#endif
