#include "ecu/e2e.h"

/* CRC of one nibble, polynomial 1Dh: 16 bytes of flash instead of 256. */
static const uint8_t CRC_NIBBLE[16] = {
    0x00, 0x1D, 0x3A, 0x27, 0x74, 0x69, 0x4E, 0x53, 0xE8, 0xF5, 0xD2, 0xCF, 0x9C, 0x81, 0xA6, 0xBB,
};

static uint8_t crc_add(uint8_t crc, uint8_t byte)
{
    crc ^= byte;
    crc = (uint8_t)((uint8_t)(crc << 4) ^ CRC_NIBBLE[crc >> 4]);
    return (uint8_t)((uint8_t)(crc << 4) ^ CRC_NIBBLE[crc >> 4]);
}

uint8_t e2e_crc(uint16_t data_id, const uint8_t data[8])
{
    uint8_t crc = crc_add(0, (uint8_t)(data_id & 0xFFu));
    crc = crc_add(crc, (uint8_t)(data_id >> 8));
    for (uint8_t k = 1; k < 8u; k++) {
        crc = crc_add(crc, data[k]);
    }
    return crc;
}

void e2e_protect(uint16_t data_id, uint8_t counter, uint8_t data[8])
{
    data[1] = (uint8_t)((data[1] & 0xF0u) | (counter & 0x0Fu));
    data[0] = e2e_crc(data_id, data);
}

bool e2e_intact(uint16_t data_id, const uint8_t data[8])
{
    return e2e_counter(data) < E2E_COUNTER_STATES && e2e_crc(data_id, data) == data[0];
}

uint8_t e2e_counter(const uint8_t data[8])
{
    return data[1] & 0x0Fu;
}
