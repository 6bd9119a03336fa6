/* CRC-32 as of Ethernet and zip, piece by piece. */
#ifndef ECU_CRC32_H
#define ECU_CRC32_H

#include <stdint.h>

#define CRC32_START 0u

/* CRC of what `crc` covers followed by these bytes; CRC32_START covers nothing. */
uint32_t crc32_add(uint32_t crc, const uint8_t *bytes, uint32_t length);

#endif
