#include "ecu/sdo_server.h"

#include "ecu/ecu.h"
#include "ecu/little_endian.h"
#include "ecu/object_dictionary.h"

#define SDO_LENGTH 8u
#define TIMEOUT_US 1000000u
#define SEGMENT_BYTES 7u
#define EXPEDITED_BYTES 4u

/* First byte of a frame: command in the upper three bits. */
#define COMMAND_MASK 0xE0u
#define REQUEST_DOWNLOAD_SEGMENT 0x00u
#define REQUEST_DOWNLOAD 0x20u
#define REQUEST_UPLOAD 0x40u
#define REQUEST_UPLOAD_SEGMENT 0x60u
#define COMMAND_ABORT 0x80u
#define ANSWER_UPLOAD_SEGMENT 0x00u
#define ANSWER_DOWNLOAD_SEGMENT 0x20u
#define ANSWER_UPLOAD 0x40u
#define ANSWER_DOWNLOAD 0x60u
#define BIT_TOGGLE 0x10u
#define BIT_EXPEDITED 0x02u
#define BIT_SIZE 0x01u
#define BIT_LAST 0x01u

void sdo_server_start(struct ecu *ecu)
{
    parameter_set_drop(ecu);
    ecu->sdo = (struct sdo_server){0};
}

void sdo_server_receive(struct ecu *ecu, const struct can_frame_11bit *frame)
{
    if (frame->length != SDO_LENGTH || ecu->nmt == NMT_STOPPED) {
        return;
    }
    for (uint8_t k = 0; k < SDO_LENGTH; k++) {
        ecu->sdo.frame[k] = frame->data[k];
    }
    ecu->sdo.mail = SDO_MAIL_REQUEST;
}

static void end_transfer(struct ecu *ecu)
{
    parameter_set_drop(ecu);
    ecu->sdo.transfer = SDO_IDLE;
}

/* The answer names the object of the transfer, or of the request that begins one. */
static void answer(struct sdo_server *sdo, uint8_t command, uint32_t data)
{
    sdo->frame[0] = command;
    sdo->frame[1] = (uint8_t)sdo->index;
    sdo->frame[2] = (uint8_t)(sdo->index >> 8);
    sdo->frame[3] = sdo->sub;
    put_u32(&sdo->frame[4], data);
    sdo->mail = SDO_MAIL_ANSWER;
}

static void abort_transfer(struct ecu *ecu, enum object_abort code)
{
    end_transfer(ecu);
    answer(&ecu->sdo, COMMAND_ABORT, (uint32_t)code);
}

static void begin_transfer(struct ecu *ecu, enum sdo_transfer transfer)
{
    struct sdo_server *const sdo = &ecu->sdo;
    sdo->transfer = transfer;
    sdo->toggle = false;
    sdo->count = 0;
    sdo->number = 0;
    sdo->ticks_left = (uint16_t)(TIMEOUT_US / ecu->period_us);
}

static void upload(struct ecu *ecu, const struct ecu_port *port)
{
    struct sdo_server *const sdo = &ecu->sdo;
    struct object object;
    enum object_abort result = object_find(sdo->index, sdo->sub, &object);
    uint32_t value = 0;
    if (result == OBJECT_DONE && object_is_number(&object)) {
        result = object_read(ecu, port, &object, &value);
    }
    if (result != OBJECT_DONE) {
        abort_transfer(ecu, result);
        return;
    }
    const uint32_t length = object_length(&object);
    if (!object_is_number(&object)) {
        begin_transfer(ecu, SDO_UPLOAD);
        answer(sdo, ANSWER_UPLOAD | BIT_SIZE, length);
        return;
    }
    if (length < EXPEDITED_BYTES) {
        value &= ((uint32_t)1 << (8u * length)) - 1u;
    }
    const uint32_t unused = EXPEDITED_BYTES - length;
    answer(sdo, (uint8_t)(ANSWER_UPLOAD | unused << 2 | BIT_EXPEDITED | BIT_SIZE), value);
}

static void upload_segment(struct ecu *ecu)
{
    struct sdo_server *const sdo = &ecu->sdo;
    struct object object;
    const enum object_abort found = object_find(sdo->index, sdo->sub, &object);
    if (found != OBJECT_DONE) {
        abort_transfer(ecu, found); /* cannot be: the transfer began with it */
        return;
    }
    const uint32_t left = object_length(&object) - sdo->count;
    const uint8_t length = (uint8_t)(left < SEGMENT_BYTES ? left : SEGMENT_BYTES);
    const bool last = length == left;
    for (uint8_t k = 0; k < SEGMENT_BYTES; k++) {
        sdo->frame[1u + k] = k < length ? object_byte(ecu, &object, sdo->count + k) : (uint8_t)0;
    }
    sdo->frame[0] = (uint8_t)(ANSWER_UPLOAD_SEGMENT | (sdo->toggle ? BIT_TOGGLE : 0u) |
                              ((SEGMENT_BYTES - length) << 1) | (last ? BIT_LAST : 0u));
    sdo->mail = SDO_MAIL_ANSWER;
    sdo->count += length;
    sdo->toggle = !sdo->toggle;
    if (last) {
        end_transfer(ecu);
    }
}

static void download(struct ecu *ecu, const struct ecu_port *port)
{
    struct sdo_server *const sdo = &ecu->sdo;
    struct object object;
    const uint8_t command = sdo->frame[0];
    const uint32_t data = get_u32(&sdo->frame[4]);
    enum object_abort result = object_find(sdo->index, sdo->sub, &object);
    if (result == OBJECT_DONE) {
        result = object_may_write(ecu, &object);
    }
    if (result != OBJECT_DONE) {
        abort_transfer(ecu, result);
        return;
    }
    const uint32_t length = object_length(&object);
    const bool expedited = (command & BIT_EXPEDITED) != 0u;
    const bool size_told = (command & BIT_SIZE) != 0u;
    const uint32_t told = expedited ? EXPEDITED_BYTES - ((uint32_t)command >> 2 & 3u) : data;
    if ((size_told && told != length) || (expedited && length > EXPEDITED_BYTES)) {
        abort_transfer(ecu, ABORT_LENGTH);
        return;
    }
    if (!expedited) {
        begin_transfer(ecu, SDO_DOWNLOAD);
        if (object_is_image(&object)) {
            parameter_set_begin(ecu);
        }
        answer(sdo, ANSWER_DOWNLOAD, 0);
        return;
    }
    const uint32_t mask = length < EXPEDITED_BYTES ? ((uint32_t)1 << (8u * length)) - 1u : UINT32_MAX;
    result = object_write(ecu, port, &object, data & mask);
    if (result != OBJECT_DONE) {
        abort_transfer(ecu, result);
        return;
    }
    answer(sdo, ANSWER_DOWNLOAD, 0);
}

static enum object_abort take_image(struct ecu *ecu)
{
    uint16_t entry = 0;
    const enum ecu_status status = parameter_set_take(ecu, &entry);
    switch (status) {
    case ECU_OK:
        return OBJECT_DONE;
    case ECU_IMAGE_DAMAGED:
        return ABORT_CRC;
    case ECU_PARAMETER_RANGE:
        ecu->refused_parameter = entry;
        return ABORT_RANGE;
    case ECU_PARAMETER_RELATION:
        ecu->refused_parameter = entry;
        return ABORT_INCOMPATIBLE;
    case ECU_IMAGE_OTHER_LAYOUT:
    case ECU_PERIOD_RANGE:
        return ABORT_INCOMPATIBLE;
    case ECU_IMAGE_NOT_ONE:
    case ECU_IMAGE_BASES:
    default:
        return ABORT_RANGE;
    }
}

/* All segments have come: whatever was written counts from here on, and not before. */
static enum object_abort finish_download(struct ecu *ecu, const struct ecu_port *port,
                                         const struct object *object)
{
    const struct sdo_server *const sdo = &ecu->sdo;
    if (sdo->count != object_length(object)) {
        return ABORT_LENGTH;
    }
    if (!object_is_image(object)) {
        return object_write(ecu, port, object, sdo->number);
    }
    const enum object_abort result = object_may_write(ecu, object);
    return result == OBJECT_DONE ? take_image(ecu) : result;
}

static void download_segment(struct ecu *ecu, const struct ecu_port *port)
{
    struct sdo_server *const sdo = &ecu->sdo;
    struct object object;
    const uint8_t command = sdo->frame[0];
    const uint8_t length = (uint8_t)(SEGMENT_BYTES - ((uint32_t)command >> 1 & 7u));
    enum object_abort result = object_find(sdo->index, sdo->sub, &object);
    if (result == OBJECT_DONE && length > object_length(&object) - sdo->count) {
        result = ABORT_LENGTH;
    }
    if (result == OBJECT_DONE && object_is_image(&object)) {
        result = parameter_set_add(ecu, &sdo->frame[1], length) ? OBJECT_DONE : ABORT_LENGTH;
    } else if (result == OBJECT_DONE) {
        for (uint8_t k = 0; k < length; k++) {
            sdo->number |= (uint32_t)sdo->frame[1u + k] << (8u * (sdo->count + k));
        }
    }
    sdo->count += length;
    const bool last = (command & BIT_LAST) != 0u;
    if (result == OBJECT_DONE && last) {
        result = finish_download(ecu, port, &object);
    }
    if (result != OBJECT_DONE) {
        abort_transfer(ecu, result);
        return;
    }
    const uint8_t toggle = sdo->toggle ? BIT_TOGGLE : 0u;
    for (uint8_t k = 1; k < SDO_LENGTH; k++) {
        sdo->frame[k] = 0;
    }
    sdo->frame[0] = ANSWER_DOWNLOAD_SEGMENT | toggle;
    sdo->mail = SDO_MAIL_ANSWER;
    sdo->toggle = !sdo->toggle;
    if (last) {
        end_transfer(ecu);
    }
}

static void segment(struct ecu *ecu, const struct ecu_port *port, enum sdo_transfer wanted)
{
    struct sdo_server *const sdo = &ecu->sdo;
    if (sdo->transfer != wanted) {
        abort_transfer(ecu, ABORT_COMMAND);
        return;
    }
    if (((sdo->frame[0] & BIT_TOGGLE) != 0u) != sdo->toggle) {
        abort_transfer(ecu, ABORT_TOGGLE);
        return;
    }
    sdo->ticks_left = (uint16_t)(TIMEOUT_US / ecu->period_us);
    if (wanted == SDO_UPLOAD) {
        upload_segment(ecu);
    } else {
        download_segment(ecu, port);
    }
}

static void work_on_request(struct ecu *ecu, const struct ecu_port *port)
{
    struct sdo_server *const sdo = &ecu->sdo;
    const uint8_t command = sdo->frame[0] & COMMAND_MASK;
    sdo->mail = SDO_MAIL_NONE;
    if (command == REQUEST_DOWNLOAD_SEGMENT) {
        segment(ecu, port, SDO_DOWNLOAD);
        return;
    }
    if (command == REQUEST_UPLOAD_SEGMENT) {
        segment(ecu, port, SDO_UPLOAD);
        return;
    }
    end_transfer(ecu); /* what else comes ends a transfer: the client has begun another, or given up */
    if (command == COMMAND_ABORT) {
        return;
    }
    sdo->index = (uint16_t)(sdo->frame[1] | (uint32_t)sdo->frame[2] << 8);
    sdo->sub = sdo->frame[3];
    if (command == REQUEST_UPLOAD) {
        upload(ecu, port);
    } else if (command == REQUEST_DOWNLOAD) {
        download(ecu, port);
    } else {
        abort_transfer(ecu, ABORT_COMMAND);
    }
}

void sdo_server_send(struct ecu *ecu, const struct ecu_port *port)
{
    struct sdo_server *const sdo = &ecu->sdo;
    if (ecu->nmt == NMT_STOPPED) {
        sdo->mail = SDO_MAIL_NONE;
        return;
    }
    if (sdo->mail == SDO_MAIL_REQUEST) {
        work_on_request(ecu, port);
    }
    if (sdo->mail == SDO_MAIL_ANSWER) {
        struct can_frame_11bit frame = {.id = SDO_ANSWER_ID, .length = SDO_LENGTH};
        for (uint8_t k = 0; k < SDO_LENGTH; k++) {
            frame.data[k] = sdo->frame[k];
        }
        if (port->send(port->context, &frame) == PORT_OK) {
            sdo->mail = SDO_MAIL_NONE;
        }
    }
}

void sdo_server_tick(struct ecu *ecu)
{
    struct sdo_server *const sdo = &ecu->sdo;
    if (sdo->transfer == SDO_IDLE || sdo->mail == SDO_MAIL_REQUEST) {
        return;
    }
    sdo->ticks_left--;
    if (sdo->ticks_left == 0u) {
        abort_transfer(ecu, ABORT_TIMEOUT);
    }
}
