/* Parameters that survive power-off: two slots of flash or of a file, written in turn. A set counts from the moment
 * its header is there, which is written last; so power may go at any time, and the set before or the new one is
 * found afterwards.
 *
 * Saving and restoring wait for the flash, so they are for modes in which the valves are shut. */
#ifndef ECU_STORE_H
#define ECU_STORE_H

#include <stdbool.h>
#include <stdint.h>

#include "ecu/parameters.h"

#define STORE_SLOTS 2u
#define STORE_WORD_BYTES 8u /* programmed as a whole: flash with error correction allows no less */
#define STORE_HEADER_BYTES 24u
#define STORE_BODY_BYTES \
    ((PARAMETER_IMAGE_BYTES + STORE_WORD_BYTES - 1u) / STORE_WORD_BYTES * STORE_WORD_BYTES)
/* What a slot needs: the header, then the image, filled up to a whole word. */
#define STORE_SLOT_BYTES (STORE_HEADER_BYTES + STORE_BODY_BYTES)

/* The memory, as the store sees it. All three wait until it is done, and return false when it cannot be done. */
struct store_port {
    void *context; /* handed to every function below */
    bool (*read)(void *context, uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t length);
    /* Every byte of the slot becomes FFh. A slot is erased alone: the other one keeps its bytes. */
    bool (*erase)(void *context, uint8_t slot);
    /* Offset and length are whole words, inside an erased part; no word is programmed twice. */
    bool (*program)(void *context, uint8_t slot, uint32_t offset, const uint8_t *bytes, uint32_t length);
};

enum store_status {
    STORE_OK,      /* the newest set is loaded; saved, restored */
    STORE_EMPTY,   /* nothing was ever saved, or the default was restored: no error */
    STORE_OLDER,   /* one slot is damaged and may have held a newer set; the other one's set is loaded */
    STORE_DAMAGED, /* there is something, but no whole set */
    STORE_FOREIGN, /* the newest set was saved by firmware with another list of parameters */
    STORE_FAILED /* the memory could not be read, erased or programmed; or it is worn out: what was written is
                    * not what is read */
};

/* The newest set. *image is the set with STORE_OK and STORE_OLDER, is as it was with STORE_EMPTY, STORE_DAMAGED and
 * STORE_FOREIGN, and is not to be used with STORE_FAILED. What the numbers mean is parameters_load's to check. */
enum store_status store_load(const struct store_port *port, struct parameter_image *image);

/* Write a set beside the newest one and read it back: STORE_OK or STORE_FAILED, then the sets before are as they
 * were, except that a damaged one may be gone. */
enum store_status store_save(const struct store_port *port, const struct parameter_image *image);

/* CiA 301 1011h: from the next start on store_load says STORE_EMPTY, and the ECU uses its default. Written like a
 * set, so what goes for power and failures with store_save goes for this, too. */
enum store_status store_restore_default(const struct store_port *port);

#endif
