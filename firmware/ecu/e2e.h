/* AUTOSAR E2E profile 1, data id mode BOTH: CRC-8 in byte 0, counter 0..14 in the low nibble of byte 1. The
 * data id is the frame's identifier. Detects what a bus does to a frame; no claim of a safety rating. */
#ifndef ECU_E2E_H
#define ECU_E2E_H

#include <stdbool.h>
#include <stdint.h>

#define E2E_COUNTER_STATES 15u /* 0..14; 15 is never sent */

/* CRC-8 of a frame of 8 bytes: polynomial 1Dh, start 0, over the data id and bytes 1..7. */
uint8_t e2e_crc(uint16_t data_id, const uint8_t data[8]);

/* Put counter (0..14) and CRC into a frame whose other bytes are final. */
void e2e_protect(uint16_t data_id, uint8_t counter, uint8_t data[8]);

/* True when CRC and counter's range are right. */
bool e2e_intact(uint16_t data_id, const uint8_t data[8]);

/* Counter of a frame, 0..15. */
uint8_t e2e_counter(const uint8_t data[8]);

#endif
