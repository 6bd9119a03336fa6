/* The object dictionary: what SDO reads and writes. The table is can_protocol/objects.toml; parameters, estimates and
 * the objects of process frames are found by their index. */
#ifndef ECU_OBJECT_DICTIONARY_H
#define ECU_OBJECT_DICTIONARY_H

#include <stdbool.h>
#include <stdint.h>

#include "ecu/generated/object_layout.h"
#include "ecu/port.h"

struct ecu;

/* Abort codes of CiA 301. */
enum object_abort {
    OBJECT_DONE = 0,
    ABORT_TOGGLE = 0x05030000,
    ABORT_TIMEOUT = 0x05040000,
    ABORT_COMMAND = 0x05040001,
    ABORT_CRC = 0x05040004,
    ABORT_READ_ONLY = 0x06010002,
    ABORT_NO_OBJECT = 0x06020000,
    ABORT_INCOMPATIBLE = 0x06040043,
    ABORT_HARDWARE = 0x06060000,
    ABORT_LENGTH = 0x06070010,
    ABORT_NO_SUB_INDEX = 0x06090011,
    ABORT_RANGE = 0x06090030,
    ABORT_TOO_HIGH = 0x06090031,
    ABORT_TOO_LOW = 0x06090032,
    ABORT_NOT_STORED = 0x08000020,
    ABORT_STATE = 0x08000022,
    ABORT_NO_DATA = 0x08000024
};

enum object_kind {
    OBJECT_ROW, /* of the table */
    OBJECT_PARAMETER,
    OBJECT_ESTIMATE,
    OBJECT_ESTIMATE_SD,
    OBJECT_PDO_COMMUNICATION,
    OBJECT_PDO_MAPPING,
    OBJECT_FRAME
};

struct object {
    enum object_kind kind;
    enum object_type type;
    uint16_t at;    /* row, parameter, estimate or PDO */
    uint8_t sub;    /* sub-index */
    uint8_t access; /* for this file */
};

enum object_abort object_find(uint16_t index, uint8_t sub, struct object *object);

/* In bytes; up to 4 is a number, texts and the image are read and written byte by byte. */
uint32_t object_length(const struct object *object);
bool object_is_number(const struct object *object);
bool object_is_image(const struct object *object);

/* A number's bytes, the first one lowest. */
enum object_abort object_read(const struct ecu *ecu, const struct ecu_port *port, const struct object *object,
                              uint32_t *value);

/* Of a text or the image; offset < object_length. */
uint8_t object_byte(const struct ecu *ecu, const struct object *object, uint32_t offset);

/* Whether it may be written now. */
enum object_abort object_may_write(const struct ecu *ecu, const struct object *object);

/* Write a number, or leave everything as it was. */
enum object_abort object_write(struct ecu *ecu, const struct ecu_port *port, const struct object *object,
                               uint32_t value);

#endif
