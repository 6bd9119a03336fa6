#include "ports/fmu/instance.h"

#include <math.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>

#include "ecu/e2e.h"

#define FIRST_NUMBER 12u /* of a parameter image, in bytes */
#define NMT_START 1u
#define REQUEST_MOVE 3
#define REQUEST_LAST 8
#define CONTROLLER_LAST 2
#define DURATION_LAST_MS 65535
#define TARGET_LAST 8388607
#define LONGEST_STEP_TICKS 1000000.0

/* Where a field stands in a frame's data. */
struct field {
    uint8_t start, length; /* bits */
};

struct sensor_row {
    uint16_t frame;
    struct field field;
    int32_t low, high, invalid; /* raw */
    double step;                /* SI value of one raw step */
};

struct output_row {
    uint16_t frame;
    struct field selector; /* length 0: none */
    uint8_t page;
    struct field field;
    bool is_signed;
    double step;
};

static const struct sensor_row SENSORS[FMU_SENSOR_COUNT] = {FMU_SENSORS};
static const struct output_row OUTPUTS[FMU_OUTPUT_COUNT] = {FMU_OUTPUTS};
static const uint16_t SENSOR_FRAMES[] = {FMU_SENSOR_FRAMES};
static const struct field REQUEST = FMU_MOTION_REQUEST;
static const struct field JOINT = FMU_MOTION_JOINT;
static const struct field CONTROLLER = FMU_MOTION_CONTROLLER;
static const struct field TARGET = FMU_MOTION_TARGET;
static const struct field DURATION = FMU_MOTION_DURATION;

bool instance_refuse(struct instance *instance, const char *format, ...)
{
    va_list values;
    va_start(values, format);
    (void)vsnprintf(instance->text, sizeof instance->text, format, values);
    va_end(values);
    return false;
}

/* ---- bits ---- */

static void put(uint8_t data[8], struct field field, uint32_t raw)
{
    for (uint32_t k = 0; k < field.length; k++) {
        const uint32_t bit = field.start + k;
        const uint8_t mask = (uint8_t)(1u << (bit & 7u));
        data[bit >> 3] = (uint8_t)((raw >> k & 1u) != 0u ? data[bit >> 3] | mask : data[bit >> 3] & ~mask);
    }
}

static uint32_t get(const uint8_t data[8], struct field field)
{
    uint32_t raw = 0;
    for (uint32_t k = 0; k < field.length; k++) {
        const uint32_t bit = field.start + k;
        raw |= (data[bit >> 3] >> (bit & 7u) & 1u) << k;
    }
    return raw;
}

/* To the nearest step, halves away from zero, limited: as the I/O node does it. */
static int32_t quantise(double value, double step, int32_t low, int32_t high)
{
    const double scaled = value / step;
    if (!(scaled > low)) {
        return low;
    }
    if (scaled >= high) {
        return high;
    }
    return (int32_t)(scaled < 0.0 ? scaled - 0.5 : scaled + 0.5);
}

static double decode(const struct output_row *row, const uint8_t data[8])
{
    const uint32_t raw = get(data, row->field);
    double value = (double)raw;
    if (row->is_signed && (raw >> (row->field.length - 1u) & 1u) != 0u) {
        value -= ldexp(1.0, row->field.length);
    }
    return value * row->step;
}

/* ---- the bus, seen from the ECU ---- */

static void hear(struct instance *instance, const struct can_frame_11bit *frame)
{
    if (frame->id == FMU_SYNC_ID) {
        instance->sync_counter = frame->data[0];
    }
    for (size_t k = 0; k < FMU_OUTPUT_COUNT; k++) {
        const struct output_row *const row = &OUTPUTS[k];
        if (row->frame == frame->id &&
            (row->selector.length == 0u || get(frame->data, row->selector) == row->page)) {
            instance->output[k] = decode(row, frame->data);
        }
    }
    if (frame->id == FMU_VALVES_ID) {
        const struct field control[JOINTS] = {FMU_VALVES_CONTROL};
        instance->valves_active = true;
        for (size_t i = 0; i < JOINTS; i++) {
            instance->valves_active =
                instance->valves_active && get(frame->data, control[i]) == FMU_VALVES_ACTIVE;
        }
    }
}

static enum port_status take_sent(void *context, const struct can_frame_11bit *frame)
{
    hear(context, frame);
    return PORT_OK;
}

static enum port_status give_received(void *context, struct can_frame_11bit *frame)
{
    struct instance *const instance = context;
    if (instance->taken >= instance->queued) {
        return PORT_EMPTY;
    }
    *frame = instance->queue[instance->taken++];
    return PORT_OK;
}

static uint32_t no_time_us(void *context)
{
    (void)context;
    return 0;
}

static struct ecu_port port_of(struct instance *instance)
{
    return (struct ecu_port){
        .context = instance, .send = take_sent, .receive = give_received, .now_us = no_time_us};
}

static struct can_frame_11bit *add_frame(struct instance *instance, uint32_t id, uint8_t length)
{
    struct can_frame_11bit *const frame = &instance->queue[instance->queued++];
    *frame = (struct can_frame_11bit){.id = id, .length = length};
    return frame;
}

static void add_motion(struct instance *instance, int32_t request, size_t joint)
{
    struct can_frame_11bit *const frame = add_frame(instance, FMU_MOTION_ID, 8);
    const int32_t target =
        quantise(instance->target_rad[joint], FMU_MOTION_TARGET_STEP, -TARGET_LAST, TARGET_LAST);
    const bool is_move = request == REQUEST_MOVE;
    put(frame->data, REQUEST, (uint32_t)request);
    put(frame->data, JOINT, (uint32_t)joint);
    put(frame->data, CONTROLLER, is_move ? 0u : (uint32_t)instance->controller);
    put(frame->data, TARGET, is_move ? (uint32_t)target : 0u);
    put(frame->data, DURATION,
        is_move ? (uint32_t)quantise(instance->duration_s[joint], 1e-3, 1, DURATION_LAST_MS) : 1u);
    e2e_protect((uint16_t)frame->id, instance->motion_counter, frame->data);
    instance->motion_counter = (uint8_t)((instance->motion_counter + 1u) % E2E_COUNTER_STATES);
}

/* What the master says in this tick: the network's start, and every request and move with a rising edge. */
static void add_requests(struct instance *instance)
{
    if (!instance->is_network_started) {
        add_frame(instance, FMU_NMT_ID, 2)->data[0] = NMT_START;
        instance->is_network_started = true;
    }
    if (instance->request != instance->last_request && instance->request != 0) {
        add_motion(instance, instance->request, 0);
    }
    instance->last_request = instance->request;
    for (size_t i = 0; i < JOINTS; i++) {
        if (instance->move[i] && !instance->last_move[i]) {
            add_motion(instance, REQUEST_MOVE, i);
        }
        instance->last_move[i] = instance->move[i];
    }
}

static void add_sensors(struct instance *instance)
{
    const uint8_t counter = (uint8_t)((instance->sync_counter - 1u) % E2E_COUNTER_STATES);
    for (size_t n = 0; n < sizeof SENSOR_FRAMES / sizeof SENSOR_FRAMES[0]; n++) {
        struct can_frame_11bit *const frame = add_frame(instance, SENSOR_FRAMES[n], 8);
        for (size_t k = 0; k < FMU_SENSOR_COUNT; k++) {
            const struct sensor_row *const row = &SENSORS[k];
            if (row->frame == frame->id) {
                const double value = instance->sensor[k];
                put(frame->data, row->field,
                    (uint32_t)(isnan(value) ? row->invalid
                                            : quantise(value, row->step, row->low, row->high)));
            }
        }
        e2e_protect((uint16_t)frame->id, counter, frame->data);
    }
}

static void tick(struct instance *instance)
{
    const struct ecu_port port = port_of(instance);
    ecu_tick_begin(&instance->ecu, &port);
    instance->queued = 0;
    instance->taken = 0;
    add_requests(instance);
    add_sensors(instance);
    while (instance->taken < instance->queued) {
        (void)ecu_tick_receive(&instance->ecu, &port);
    }
    ecu_tick_end(&instance->ecu, &port);
}

/* ---- parameters ---- */

static void write_u32(uint8_t *bytes, uint32_t value)
{
    for (uint32_t k = 0; k < 4u; k++) {
        bytes[k] = (uint8_t)(value >> (8u * k));
    }
}

static void write_real32(struct parameter_image *image, uint32_t entry, float value)
{
    uint32_t bits;
    (void)memcpy(&bits, &value, sizeof bits);
    write_u32(&image->bytes[FIRST_NUMBER + 4u * entry], bits);
}

static float read_real32(const struct parameter_image *image, uint32_t entry)
{
    uint32_t bits = 0;
    for (uint32_t k = 0; k < 4u; k++) {
        bits |= (uint32_t)image->bytes[FIRST_NUMBER + 4u * entry + k] << (8u * k);
    }
    float value;
    (void)memcpy(&value, &bits, sizeof value);
    return value;
}

static void seal(struct parameter_image *image)
{
    const size_t length = sizeof image->bytes - 4u;
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t k = 0; k < length; k++) {
        crc ^= image->bytes[k];
        for (uint8_t bit = 0; bit < 8u; bit++) {
            crc = (crc >> 1) ^ ((crc & 1u) != 0u ? 0xEDB88320u : 0u);
        }
    }
    write_u32(&image->bytes[length], ~crc);
}

bool instance_get_parameter(struct instance *instance, uint32_t entry, double *value)
{
    if (entry >= PARAMETER_COUNT) {
        return instance_refuse(instance, "there is no parameter %u", (unsigned)entry);
    }
    *value = (double)read_real32(&instance->image, entry);
    return true;
}

bool instance_set_parameter(struct instance *instance, uint32_t entry, double value)
{
    if (entry >= PARAMETER_COUNT) {
        return instance_refuse(instance, "there is no parameter %u", (unsigned)entry);
    }
    if (instance->phase != PHASE_NEW && instance->phase != PHASE_INITIALISING) {
        return instance_refuse(instance, "parameter %s cannot be set after initialisation",
                               parameter_name((uint16_t)entry));
    }
    if (!isfinite(value) || fabs(value) > 1e30) {
        return instance_refuse(instance, "parameter %s cannot be %g", parameter_name((uint16_t)entry), value);
    }
    write_real32(&instance->image, entry, (float)value);
    instance->is_given[entry] = true;
    return true;
}

static bool read_image(struct instance *instance, struct parameter_image *image)
{
    FILE *const file = fopen(instance->image_path, "rb");
    if (file == NULL) {
        return instance_refuse(instance, "%.200s: the parameter image cannot be opened",
                               instance->image_path);
    }
    const size_t got = fread(image->bytes, 1, sizeof image->bytes, file);
    const bool is_longer = fgetc(file) != EOF;
    (void)fclose(file);
    if (got != sizeof image->bytes || is_longer) {
        return instance_refuse(instance, "%.200s: a parameter image of this firmware has %u bytes",
                               instance->image_path, (unsigned)sizeof image->bytes);
    }
    return true;
}

/* ---- the life of an instance ---- */

void instance_reset(struct instance *instance)
{
    *instance =
        (struct instance){.phase = PHASE_NEW, .controller = CONTROLLER_LAST, .period_s = FMU_PERIOD_S};
    instance->image = default_parameter_image;
    for (size_t i = 0; i < JOINTS; i++) {
        instance->duration_s[i] = FMU_DURATION_S;
    }
}

bool instance_start(struct instance *instance)
{
    if (instance->phase != PHASE_INITIALISING) {
        return instance_refuse(instance, "initialisation mode was not entered");
    }
    struct parameter_image image = instance->image;
    if (instance->image_path[0] != '\0') {
        if (!read_image(instance, &image)) {
            return false;
        }
        const struct parameter_image file = image;
        uint16_t entry = 0;
        enum ecu_status status = ecu_init(&instance->ecu, &file, FMU_PERIOD_US, &entry);
        if (status != ECU_OK && status != ECU_PARAMETER_RANGE && status != ECU_PARAMETER_RELATION &&
            status != ECU_PERIOD_RANGE) {
            return instance_refuse(instance, "%.200s: the image %s", instance->image_path,
                                   ecu_status_text(status));
        }
        for (uint32_t k = 0; k < PARAMETER_COUNT; k++) {
            if (instance->is_given[k]) {
                write_real32(&image, k, read_real32(&instance->image, k));
            }
        }
    }
    seal(&image);
    const double period_us = instance->period_s * 1e6;
    if (!(period_us >= ECU_PERIOD_LOW_US && period_us <= ECU_PERIOD_HIGH_US) ||
        fabs(period_us - nearbyint(period_us)) > 1e-3) {
        return instance_refuse(instance,
                               "a tick_period of %g s is not possible: whole microseconds from %u to %u us",
                               instance->period_s, ECU_PERIOD_LOW_US, ECU_PERIOD_HIGH_US);
    }
    uint16_t entry = 0;
    const enum ecu_status status = ecu_init(&instance->ecu, &image, (uint32_t)nearbyint(period_us), &entry);
    if (status != ECU_OK) {
        return instance_refuse(
            instance, "the firmware refuses its parameters: the image %s (parameter %s)",
            ecu_status_text(status),
            status == ECU_PARAMETER_RANGE || status == ECU_PARAMETER_RELATION ? parameter_name(entry) : "-");
    }
    instance->image = image;
    instance->phase = PHASE_STEPPING;
    return true;
}

bool instance_step(struct instance *instance, double time_s, double step_s)
{
    if (instance->phase != PHASE_STEPPING) {
        return instance_refuse(instance, "a step needs an initialised FMU that is not terminated");
    }
    const double ticks = nearbyint(step_s / instance->period_s);
    if (!(ticks >= 1.0 && ticks <= LONGEST_STEP_TICKS) ||
        fabs(step_s - ticks * instance->period_s) > 1e-6 * instance->period_s) {
        return instance_refuse(
            instance,
            "a step of %g s is not possible: one step is one tick of %g s, or a whole number of "
            "ticks; set the communication step to that, or the parameter tick_period",
            step_s, instance->period_s);
    }
    if (instance->request < 0 || instance->request > REQUEST_LAST || instance->controller < 0 ||
        instance->controller > CONTROLLER_LAST) {
        return instance_refuse(instance, "request %d or controller %d is none: 0 to %d and 0 to %d are",
                               (int)instance->request, (int)instance->controller, REQUEST_LAST,
                               CONTROLLER_LAST);
    }
    for (double done = 0.0; done < ticks; done += 1.0) {
        tick(instance);
    }
    instance->time_s = time_s + step_s;
    return true;
}

bool instance_terminate(struct instance *instance)
{
    if (instance->phase != PHASE_STEPPING) {
        return instance_refuse(instance, "there is nothing to terminate");
    }
    const struct ecu_port port = port_of(instance);
    ecu_shutdown(&instance->ecu, &port);
    instance->phase = PHASE_TERMINATED;
    return true;
}
