#include "ecu/crc32.h"

uint32_t crc32_add(uint32_t crc, const uint8_t *bytes, uint32_t length)
{
    uint32_t register_bits = ~crc;
    for (uint32_t k = 0; k < length; k++) {
        register_bits ^= bytes[k];
        for (uint8_t bit = 0; bit < 8u; bit++) {
            register_bits = (register_bits >> 1) ^ ((register_bits & 1u) != 0u ? 0xEDB88320u : 0u);
        }
    }
    return ~register_bits;
}
