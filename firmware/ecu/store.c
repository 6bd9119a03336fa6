#include "ecu/store.h"

#include <stddef.h>

#include "ecu/crc32.h"
#include "ecu/little_endian.h"

/* A slot: the header's six numbers of 32 bits, then the image. The header's last word is programmed last of all, so
 * while it is blank the slot holds nothing that was ever promised. */
enum header_field {
    HEADER_MAGIC = 0,
    HEADER_KIND = 4,
    HEADER_LAYOUT = 8,
    HEADER_SEQUENCE = 12, /* one more with each save, and round again */
    HEADER_BODY_CRC = 16,
    HEADER_CRC = 20 /* of the five before it */
};

#define MAGIC 0x54455344u        /* "DSET" */
#define KIND_IMAGE 0x47414D49u   /* "IMAG": the body is a parameter image */
#define KIND_DEFAULT 0x41464544u /* "DEFA": no body, the default is wanted */

#define LAST_WORD (STORE_HEADER_BYTES - STORE_WORD_BYTES)
#define CHUNK_BYTES 32u
#define ERASED 0xFFu

_Static_assert(STORE_HEADER_BYTES == HEADER_CRC + 4, "the header's fields fill it");
_Static_assert(STORE_HEADER_BYTES % STORE_WORD_BYTES == 0 && CHUNK_BYTES % STORE_WORD_BYTES == 0,
               "only whole words are programmed");
_Static_assert(STORE_HEADER_BYTES <= CHUNK_BYTES, "a chunk holds the header");

enum slot_state {
    SLOT_UNFINISHED, /* blank, or the save was cut short before it counted */
    SLOT_DAMAGED,
    SLOT_FOREIGN, /* whole as far as the header tells; of another list of parameters */
    SLOT_IMAGE,
    SLOT_DEFAULT
};

struct slot {
    enum slot_state state;
    bool legible; /* the header is whole: sequence and body_crc are true, even where the body is damaged */
    uint32_t sequence;
    uint32_t body_crc;
};

static uint32_t least(uint32_t a, uint32_t b)
{
    return a < b ? a : b;
}

/* The body's CRC, taken chunk by chunk; with `image` the bytes are kept, too. */
static bool read_body(const struct store_port *port, uint8_t slot, struct parameter_image *image,
                      uint32_t *crc)
{
    uint8_t chunk[CHUNK_BYTES];
    *crc = CRC32_START;
    for (uint32_t done = 0; done < PARAMETER_IMAGE_BYTES; done += CHUNK_BYTES) {
        const uint32_t length = least(CHUNK_BYTES, PARAMETER_IMAGE_BYTES - done);
        if (!port->read(port->context, slot, STORE_HEADER_BYTES + done, chunk, length)) {
            return false;
        }
        *crc = crc32_add(*crc, chunk, length);
        for (uint32_t k = 0; image != NULL && k < length; k++) {
            image->bytes[done + k] = chunk[k];
        }
    }
    return true;
}

/* A slot that cannot be read is a damaged one. */
static struct slot examine(const struct store_port *port, uint8_t slot)
{
    struct slot found = {.state = SLOT_DAMAGED};
    uint8_t header[STORE_HEADER_BYTES];
    if (!port->read(port->context, slot, 0, header, STORE_HEADER_BYTES)) {
        return found;
    }
    bool last_word_blank = true;
    for (uint32_t k = LAST_WORD; k < STORE_HEADER_BYTES; k++) {
        last_word_blank = last_word_blank && header[k] == ERASED;
    }
    if (last_word_blank) {
        found.state = SLOT_UNFINISHED;
        return found;
    }
    if (get_u32(&header[HEADER_MAGIC]) != MAGIC ||
        get_u32(&header[HEADER_CRC]) != crc32_add(CRC32_START, header, HEADER_CRC)) {
        return found;
    }
    found.legible = true;
    found.sequence = get_u32(&header[HEADER_SEQUENCE]);
    found.body_crc = get_u32(&header[HEADER_BODY_CRC]);
    const uint32_t kind = get_u32(&header[HEADER_KIND]);
    uint32_t crc = 0;
    if (kind == KIND_DEFAULT) {
        found.state = SLOT_DEFAULT;
    } else if (kind != KIND_IMAGE || get_u32(&header[HEADER_LAYOUT]) != PARAMETER_LAYOUT_HASH) {
        found.state = SLOT_FOREIGN;
    } else if (read_body(port, slot, NULL, &crc) && crc == found.body_crc) {
        found.state = SLOT_IMAGE;
    }
    return found;
}

/* The sequence goes round: of two the newer one is less than half of all numbers ahead. */
static bool is_newer(uint32_t sequence, uint32_t than)
{
    return sequence != than && sequence - than < 0x80000000u;
}

static bool is_whole(const struct slot *slot)
{
    return slot->state != SLOT_UNFINISHED && slot->state != SLOT_DAMAGED;
}

/* The slot with the newest whole set, STORE_SLOTS: there is none. */
static uint8_t newest_of(const struct slot slots[STORE_SLOTS])
{
    uint8_t newest = STORE_SLOTS;
    for (uint8_t k = 0; k < STORE_SLOTS; k++) {
        if (is_whole(&slots[k]) &&
            (newest == STORE_SLOTS || is_newer(slots[k].sequence, slots[newest].sequence))) {
            newest = k;
        }
    }
    return newest;
}

/* Did a set get lost that was newer than the newest whole one? A slot whose header is gone may have held one. */
static bool newer_one_lost(const struct slot slots[STORE_SLOTS], uint8_t newest)
{
    for (uint8_t k = 0; k < STORE_SLOTS; k++) {
        if (slots[k].state == SLOT_DAMAGED && (newest == STORE_SLOTS || !slots[k].legible ||
                                               is_newer(slots[k].sequence, slots[newest].sequence))) {
            return true;
        }
    }
    return false;
}

enum store_status store_load(const struct store_port *port, struct parameter_image *image)
{
    struct slot slots[STORE_SLOTS];
    for (uint8_t k = 0; k < STORE_SLOTS; k++) {
        slots[k] = examine(port, k);
    }
    const uint8_t newest = newest_of(slots);
    const bool lost = newer_one_lost(slots, newest);
    if (newest == STORE_SLOTS || slots[newest].state == SLOT_DEFAULT) {
        return lost ? STORE_DAMAGED : STORE_EMPTY;
    }
    if (slots[newest].state == SLOT_FOREIGN) {
        return STORE_FOREIGN;
    }
    uint32_t crc = 0;
    if (!read_body(port, newest, image, &crc) || crc != slots[newest].body_crc) {
        return STORE_FAILED; /* it was good a moment ago */
    }
    return lost ? STORE_OLDER : STORE_OK;
}

/* Program at most a chunk at an offset, and see that it is there. */
static bool program(const struct store_port *port, uint8_t slot, uint32_t offset, const uint8_t *bytes,
                    uint32_t length)
{
    uint8_t found[CHUNK_BYTES];
    if (!port->program(port->context, slot, offset, bytes, length) ||
        !port->read(port->context, slot, offset, found, length)) {
        return false;
    }
    for (uint32_t k = 0; k < length; k++) {
        if (found[k] != bytes[k]) {
            return false;
        }
    }
    return true;
}

/* The image behind the header's place, whole words of it; its CRC. */
static bool write_body(const struct store_port *port, uint8_t slot, const struct parameter_image *image,
                       uint32_t *crc)
{
    uint8_t chunk[CHUNK_BYTES];
    *crc = crc32_add(CRC32_START, image->bytes, PARAMETER_IMAGE_BYTES);
    for (uint32_t done = 0; done < STORE_BODY_BYTES; done += CHUNK_BYTES) {
        for (uint32_t k = 0; k < CHUNK_BYTES; k++) {
            chunk[k] = done + k < PARAMETER_IMAGE_BYTES ? image->bytes[done + k] : ERASED;
        }
        if (!program(port, slot, STORE_HEADER_BYTES + done, chunk,
                     least(CHUNK_BYTES, STORE_BODY_BYTES - done))) {
            return false;
        }
    }
    return true;
}

static bool write_slot(const struct store_port *port, uint8_t slot, uint32_t sequence,
                       const struct parameter_image *image)
{
    uint8_t header[STORE_HEADER_BYTES];
    uint32_t crc = 0;
    if (!port->erase(port->context, slot) || (image != NULL && !write_body(port, slot, image, &crc))) {
        return false;
    }
    put_u32(&header[HEADER_MAGIC], MAGIC);
    put_u32(&header[HEADER_KIND], image != NULL ? KIND_IMAGE : KIND_DEFAULT);
    put_u32(&header[HEADER_LAYOUT], PARAMETER_LAYOUT_HASH);
    put_u32(&header[HEADER_SEQUENCE], sequence);
    put_u32(&header[HEADER_BODY_CRC], crc);
    put_u32(&header[HEADER_CRC], crc32_add(CRC32_START, header, HEADER_CRC));
    return program(port, slot, 0, header, LAST_WORD) &&
           program(port, slot, LAST_WORD, &header[LAST_WORD], STORE_WORD_BYTES);
}

/* Into the slot that does not hold the newest set. image NULL: a set that says "default". */
static enum store_status write_set(const struct store_port *port, const struct parameter_image *image)
{
    struct slot slots[STORE_SLOTS];
    uint32_t sequence = 0;
    bool any = false;
    for (uint8_t k = 0; k < STORE_SLOTS; k++) {
        slots[k] = examine(port, k);
        if (slots[k].legible && (!any || is_newer(slots[k].sequence, sequence))) {
            sequence = slots[k].sequence;
            any = true;
        }
    }
    const uint8_t newest = newest_of(slots);
    const uint8_t target = newest == 0u ? 1u : 0u;
    /* With no whole set there is nothing to keep, and what is damaged must not be found beside the new one. */
    if (newest == STORE_SLOTS && slots[1].state == SLOT_DAMAGED && !port->erase(port->context, 1)) {
        return STORE_FAILED;
    }
    if (!write_slot(port, target, sequence + 1u, image)) {
        /* Part of a set must not count as one later, nor as a damaged one. */
        (void)port->erase(port->context, target);
        return STORE_FAILED;
    }
    return STORE_OK;
}

enum store_status store_save(const struct store_port *port, const struct parameter_image *image)
{
    return write_set(port, image);
}

enum store_status store_restore_default(const struct store_port *port)
{
    return write_set(port, NULL);
}
