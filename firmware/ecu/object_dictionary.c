#include "ecu/object_dictionary.h"

#include <stddef.h>

#include "can_protocol/generated/diarc_hash.h"
#include "ecu/ecu.h"
#include "ecu/store.h"

/* Access: the table's columns. */
#define READ 1u
#define WRITE 2u
#define IDLE 4u /* written only while the valves are shut */

enum object_source { SOURCE_VALUE, SOURCE_TEXT, SOURCE_FIELD, SOURCE_CALL };

struct object_row {
    uint16_t index;
    uint8_t sub;
    uint8_t type; /* enum object_type */
    uint8_t access;
    uint8_t source;      /* enum object_source */
    uint8_t field_bytes; /* of SOURCE_FIELD */
    uint32_t value;      /* or text, offset in struct ecu, enum object_call */
    uint32_t high;       /* what may be written at most */
};

static const struct object_row TABLE[OBJECT_ROWS] = {
#include "ecu/generated/object_table.inc"
};

struct object_text {
    const char *characters;
    uint32_t length;
};

static const struct object_text TEXTS[OBJECT_TEXTS] = {
#include "ecu/generated/object_texts.inc"
};

/* A process frame: its communication and mapping objects, its signals, its last eight bytes in struct ecu. */
struct object_pdo {
    uint16_t communication, mapping; /* indices */
    uint32_t cob_id;
    uint8_t transmission;
    uint8_t first_signal, signals;
    uint16_t data; /* offset in struct ecu */
};

static const struct object_pdo PDOS[OBJECT_PDOS] = {
#include "ecu/generated/object_pdos.inc"
};

struct object_signal {
    uint8_t start, length; /* bits */
    uint8_t type;          /* enum object_type */
};

static const struct object_signal SIGNALS[OBJECT_SIGNALS] = {
#include "ecu/generated/object_signals.inc"
};

#define PDO_COMMUNICATION_ENTRIES 2u
#define ESTIMATES (THETA_M + THETA_H)

#define SIGNATURE_SAVE 0x65766173u /* "save" */
#define SIGNATURE_LOAD 0x64616F6Cu /* "load" */
#define SAVES_ON_COMMAND 1u

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "fields are read byte by byte, the lowest first");

/* ---- where things are ---------------------------------------------------------------------------- */

/* Objects that have one value each, one index after the other. */
static enum object_abort find_in_range(uint16_t first, uint16_t count, enum object_kind kind, uint16_t index,
                                       uint8_t sub, struct object *object)
{
    if (index < first || index - first >= count) {
        return ABORT_NO_OBJECT;
    }
    if (sub != 0u) {
        return ABORT_NO_SUB_INDEX;
    }
    const uint8_t access = kind == OBJECT_PARAMETER ? READ | WRITE | IDLE : READ;
    *object = (struct object){
        .kind = kind, .type = TYPE_R32, .at = (uint16_t)(index - first), .sub = 0, .access = access};
    return OBJECT_DONE;
}

/* The table is in the order of index and sub-index. */
static enum object_abort find_row(uint16_t index, uint8_t sub, struct object *object)
{
    const uint32_t wanted = (uint32_t)index << 8 | sub;
    uint16_t first = 0; /* the row is one of first..end - 1 */
    uint16_t end = OBJECT_ROWS;
    while (end - first > 1) {
        const uint16_t middle = (uint16_t)((first + end) / 2u);
        if (((uint32_t)TABLE[middle].index << 8 | TABLE[middle].sub) <= wanted) {
            first = middle;
        } else {
            end = middle;
        }
    }
    if (TABLE[first].index != index) {
        return ABORT_NO_OBJECT; /* every object begins with sub-index 0 */
    }
    if (TABLE[first].sub != sub) {
        return ABORT_NO_SUB_INDEX;
    }
    *object = (struct object){.kind = OBJECT_ROW,
                              .type = (enum object_type)TABLE[first].type,
                              .at = first,
                              .sub = sub,
                              .access = TABLE[first].access};
    return OBJECT_DONE;
}

/* Sub-index 0 of all three kinds says how many there are. */
static enum object_abort find_pdo(uint16_t index, uint8_t sub, struct object *object)
{
    for (uint16_t k = 0; k < OBJECT_PDOS; k++) {
        const struct object_pdo *const pdo = &PDOS[k];
        *object = (struct object){.type = TYPE_U8, .at = k, .sub = sub, .access = READ};
        if (index == pdo->communication) {
            object->kind = OBJECT_PDO_COMMUNICATION;
            object->type = sub == 1u ? TYPE_U32 : TYPE_U8;
            return sub <= PDO_COMMUNICATION_ENTRIES ? OBJECT_DONE : ABORT_NO_SUB_INDEX;
        }
        const bool is_frame = index == FIRST_FRAME + k;
        if (is_frame || index == pdo->mapping) {
            object->kind = is_frame ? OBJECT_FRAME : OBJECT_PDO_MAPPING;
            if (sub > pdo->signals) {
                return ABORT_NO_SUB_INDEX;
            }
            if (sub > 0u) {
                const uint8_t type = SIGNALS[pdo->first_signal + sub - 1u].type;
                object->type = is_frame ? (enum object_type)type : TYPE_U32;
            }
            return OBJECT_DONE;
        }
    }
    return ABORT_NO_OBJECT;
}

enum object_abort object_find(uint16_t index, uint8_t sub, struct object *object)
{
    enum object_abort result =
        find_in_range(FIRST_PARAMETER, PARAMETER_COUNT, OBJECT_PARAMETER, index, sub, object);
    if (result == ABORT_NO_OBJECT) {
        result = find_in_range(FIRST_ESTIMATE, ESTIMATES, OBJECT_ESTIMATE, index, sub, object);
    }
    if (result == ABORT_NO_OBJECT) {
        result = find_in_range(FIRST_ESTIMATE_SD, ESTIMATES, OBJECT_ESTIMATE_SD, index, sub, object);
    }
    if (result == ABORT_NO_OBJECT) {
        result = find_row(index, sub, object);
    }
    if (result == ABORT_NO_OBJECT) {
        result = find_pdo(index, sub, object);
    }
    return result;
}

uint32_t object_length(const struct object *object)
{
    switch (object->type) {
    case TYPE_BOOL:
    case TYPE_I8:
    case TYPE_U8:
        return 1;
    case TYPE_I16:
    case TYPE_U16:
        return 2;
    case TYPE_I24:
    case TYPE_U24:
        return 3;
    case TYPE_TEXT:
        return TEXTS[TABLE[object->at].value].length;
    case TYPE_DOMAIN:
        return PARAMETER_IMAGE_BYTES;
    case TYPE_I32:
    case TYPE_U32:
    case TYPE_R32:
    default:
        return 4;
    }
}

bool object_is_number(const struct object *object)
{
    return object->type != TYPE_TEXT && object->type != TYPE_DOMAIN;
}

bool object_is_image(const struct object *object)
{
    return object->type == TYPE_DOMAIN;
}

/* ---- reading ------------------------------------------------------------------------------------- */

/* Binary logarithm of an estimate's base, in the order of the frame PARAMETERS. */
static int8_t base_of_estimate(const struct ecu *ecu, uint16_t k)
{
    if (k < THETA_M) {
        return base_torque(&ecu->bases);
    }
    return k == THETA_M + BETA_INVERSE ? (int8_t)-ecu->bases.pressure : base_volume(&ecu->bases);
}

static uint32_t estimate(const struct ecu *ecu, uint16_t k)
{
    const struct estimator *const estimator = &ecu->controller.estimator;
    const scalar value = k < THETA_M ? estimator->theta_m[k] : estimator->theta_h[k - THETA_M];
    return real32_from_scalar(value, base_of_estimate(ecu, k));
}

static uint32_t estimate_sd(const struct ecu *ecu, uint16_t k)
{
    const struct estimator *const estimator = &ecu->controller.estimator;
    const struct estimator_constants *const constants = &ecu->constants.estimator;
    const scalar sd = k < THETA_M ? estimator_sd_m(estimator, constants, (enum theta_m)k)
                                  : estimator_sd_h(estimator, constants, (enum theta_h)(k - THETA_M));
    return real32_from_scalar(sd, base_of_estimate(ecu, k));
}

static uint32_t field(const struct ecu *ecu, const struct object_row *row)
{
    const uint8_t *const bytes = (const uint8_t *)ecu + row->value;
    uint32_t value = 0;
    for (uint8_t k = 0; k < row->field_bytes; k++) {
        value |= (uint32_t)bytes[k] << (8u * k);
    }
    return value;
}

static enum object_abort read_call(const struct ecu *ecu, const struct ecu_port *port,
                                   const struct object *object, uint32_t *value)
{
    switch ((enum object_call)TABLE[object->at].value) {
    case CALL_ERROR_COUNT:
        *value = ecu->emergencies.count;
        break;
    case CALL_ERROR_ENTRY:
        if (object->sub > ecu->emergencies.count) {
            return ABORT_NO_DATA;
        }
        *value = ecu->emergencies.entry[object->sub - 1u];
        break;
    case CALL_STORE:
    case CALL_RESTORE:
        *value = port->store != NULL ? SAVES_ON_COMMAND : 0u;
        break;
    case CALL_ERROR_REGISTER:
        *value = fault_error_register(ecu);
        break;
    case CALL_LOAD:
        *value = estimate(ecu, M_T);
        break;
    case CALL_LOAD_SD:
        *value = estimate_sd(ecu, M_T);
        break;
    case CALL_CONTROL_WORD:
        *value = ecu->control_word;
        break;
    case CALL_STATUS_WORD:
        *value = mode_cia408_status(ecu->mode);
        break;
    case CALL_IMAGE:
    default:
        *value = 0; /* no number: nobody asks */
        break;
    }
    return OBJECT_DONE;
}

static enum object_abort read_row(const struct ecu *ecu, const struct ecu_port *port,
                                  const struct object *object, uint32_t *value)
{
    const struct object_row *const row = &TABLE[object->at];
    switch ((enum object_source)row->source) {
    case SOURCE_VALUE:
        *value = row->value;
        return OBJECT_DONE;
    case SOURCE_FIELD:
        *value = field(ecu, row);
        return OBJECT_DONE;
    case SOURCE_CALL:
        return read_call(ecu, port, object, value);
    case SOURCE_TEXT:
    default:
        *value = 0; /* no number: nobody asks */
        return OBJECT_DONE;
    }
}

static uint32_t communication(const struct object *object)
{
    if (object->sub == 0u) {
        return PDO_COMMUNICATION_ENTRIES;
    }
    return object->sub == 1u ? PDOS[object->at].cob_id : PDOS[object->at].transmission;
}

static uint32_t mapping(const struct object *object)
{
    const struct object_pdo *const pdo = &PDOS[object->at];
    if (object->sub == 0u) {
        return pdo->signals;
    }
    const uint8_t length = SIGNALS[pdo->first_signal + object->sub - 1u].length;
    return (FIRST_FRAME + object->at) << 16 | (uint32_t)object->sub << 8 | length;
}

/* A signal of the frame that was last heard or sent, its sign up to bit 31. */
static uint32_t frame_signal(const struct ecu *ecu, const struct object *object)
{
    const struct object_pdo *const pdo = &PDOS[object->at];
    if (object->sub == 0u) {
        return pdo->signals;
    }
    const struct object_signal *const signal = &SIGNALS[pdo->first_signal + object->sub - 1u];
    const uint8_t *const data = (const uint8_t *)ecu + pdo->data;
    uint32_t value = 0;
    for (uint8_t k = 0; k < signal->length; k++) {
        const uint8_t bit = (uint8_t)(signal->start + k);
        value |= ((uint32_t)data[bit / 8u] >> (bit % 8u) & 1u) << k;
    }
    const bool is_signed = object->type == TYPE_I8 || object->type == TYPE_I16 || object->type == TYPE_I24 ||
                           object->type == TYPE_I32;
    if (is_signed && (value >> (signal->length - 1u)) != 0u && signal->length < 32u) {
        value |= UINT32_MAX << signal->length;
    }
    return value;
}

enum object_abort object_read(const struct ecu *ecu, const struct ecu_port *port, const struct object *object,
                              uint32_t *value)
{
    switch (object->kind) {
    case OBJECT_PARAMETER:
        *value = parameters_get(&ecu->image, object->at);
        return OBJECT_DONE;
    case OBJECT_ESTIMATE:
        *value = estimate(ecu, object->at);
        return OBJECT_DONE;
    case OBJECT_ESTIMATE_SD:
        *value = estimate_sd(ecu, object->at);
        return OBJECT_DONE;
    case OBJECT_PDO_COMMUNICATION:
        *value = communication(object);
        return OBJECT_DONE;
    case OBJECT_PDO_MAPPING:
        *value = mapping(object);
        return OBJECT_DONE;
    case OBJECT_FRAME:
        *value = frame_signal(ecu, object);
        return OBJECT_DONE;
    case OBJECT_ROW:
    default:
        return read_row(ecu, port, object, value);
    }
}

uint8_t object_byte(const struct ecu *ecu, const struct object *object, uint32_t offset)
{
    return object_is_image(object) ? ecu->image.bytes[offset]
                                   : (uint8_t)TEXTS[TABLE[object->at].value].characters[offset];
}

/* ---- writing ------------------------------------------------------------------------------------- */

/* A mode in which the machine may change: the valves are shut, and nobody has asked for them. */
static bool is_idle(const struct ecu *ecu)
{
    return (ecu->mode == MODE_INIT || ecu->mode == MODE_STANDBY || ecu->mode == MODE_FAULT) &&
           !ecu->is_pending;
}

enum object_abort object_may_write(const struct ecu *ecu, const struct object *object)
{
    if ((object->access & WRITE) == 0u) {
        return ABORT_READ_ONLY;
    }
    return (object->access & IDLE) == 0u || is_idle(ecu) ? OBJECT_DONE : ABORT_STATE;
}

static enum object_abort write_parameter(struct ecu *ecu, uint16_t entry, uint32_t bits)
{
    const enum parameter_change change = parameter_set_change(ecu, entry, bits);
    if (change != PARAMETER_CHANGED) {
        ecu->refused_parameter = entry;
    }
    switch (change) {
    case PARAMETER_CHANGED:
        return OBJECT_DONE;
    case PARAMETER_TOO_LOW:
        return ABORT_TOO_LOW;
    case PARAMETER_TOO_HIGH:
        return ABORT_TOO_HIGH;
    case PARAMETER_CONTRADICTS:
        return ABORT_INCOMPATIBLE;
    case PARAMETER_NOT_HELD:
    default:
        return ABORT_RANGE;
    }
}

/* 1010h and 1011h. */
static enum object_abort keep(const struct ecu *ecu, const struct ecu_port *port, enum object_call call,
                              uint32_t signature)
{
    const bool save = call == CALL_STORE;
    if (port->store == NULL || signature != (save ? SIGNATURE_SAVE : SIGNATURE_LOAD)) {
        return ABORT_NOT_STORED;
    }
    const enum store_status status =
        save ? store_save(port->store, &ecu->image) : store_restore_default(port->store);
    return status == STORE_OK ? OBJECT_DONE : ABORT_HARDWARE;
}

static enum object_abort write_control_word(struct ecu *ecu, const struct ecu_port *port, uint16_t word)
{
    const enum ecu_refusal refusal = request_control_word(ecu, port, word);
    request_refused(ecu, refusal);
    if (refusal == REFUSAL_NONE) {
        return OBJECT_DONE;
    }
    return refusal == REFUSAL_UNKNOWN_REQUEST ? ABORT_RANGE : ABORT_STATE;
}

static enum object_abort write_call(struct ecu *ecu, const struct ecu_port *port, enum object_call call,
                                    uint32_t value)
{
    switch (call) {
    case CALL_ERROR_COUNT:
        ecu->emergencies.count = 0; /* high is 0: nothing else comes here */
        return OBJECT_DONE;
    case CALL_STORE:
    case CALL_RESTORE:
        return keep(ecu, port, call, value);
    case CALL_CONTROL_WORD:
        return write_control_word(ecu, port, (uint16_t)value);
    case CALL_ERROR_ENTRY:
    case CALL_IMAGE:
    case CALL_ERROR_REGISTER:
    case CALL_LOAD:
    case CALL_LOAD_SD:
    case CALL_STATUS_WORD:
    default:
        return ABORT_READ_ONLY;
    }
}

enum object_abort object_write(struct ecu *ecu, const struct ecu_port *port, const struct object *object,
                               uint32_t value)
{
    const enum object_abort refused = object_may_write(ecu, object);
    if (refused != OBJECT_DONE) {
        return refused;
    }
    if (object->kind == OBJECT_PARAMETER) {
        return write_parameter(ecu, object->at, value);
    }
    const struct object_row *const row = &TABLE[object->at];
    if (value > row->high) {
        return ABORT_RANGE;
    }
    if (row->source == SOURCE_CALL) {
        return write_call(ecu, port, (enum object_call)row->value, value);
    }
    uint8_t *const bytes = (uint8_t *)ecu + row->value;
    for (uint8_t k = 0; k < row->field_bytes; k++) {
        bytes[k] = (uint8_t)(value >> (8u * k));
    }
    if (row->value == offsetof(struct ecu, heartbeat_consumer)) {
        ecu->supervision.consumer_heard = false; /* watched from the first heartbeat on, 1016h */
    }
    return OBJECT_DONE;
}
