/* An ECU on a port of arrays, its arm held still, and a client that reads and writes its objects frame by frame. */
#ifndef SDO_CLIENT_H
#define SDO_CLIENT_H

#include "ecu/ecu.h"
#include "ecu/object_dictionary.h"
#include "ecu/store.h"
#include "testing.h"

enum { SDO_QUEUE = 64, SDO_BYTES = 1024, SDO_TIMEOUT_TICKS = 1000 };

static struct ecu ecu;

static struct {
    struct can_frame_11bit sent[SDO_QUEUE];
    unsigned sent_count;
    struct can_frame_11bit waiting[SDO_QUEUE];
    unsigned waiting_count, waiting_next;
    bool full;     /* no SDO frame is taken */
    bool silenced; /* no sensors */
    uint8_t motion_counter;
} wire;

/* A memory of arrays for the store. */
static struct {
    uint8_t bytes[STORE_SLOTS][STORE_SLOT_BYTES];
    bool broken;
} flash;

static inline bool flash_read(void *context, uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t length)
{
    TEST_ASSERT_EQUAL_PTR(&flash, context);
    memcpy(bytes, &flash.bytes[slot][offset], length);
    return true;
}

static inline bool flash_erase(void *context, uint8_t slot)
{
    TEST_ASSERT_EQUAL_PTR(&flash, context);
    memset(flash.bytes[slot], 0xFF, sizeof flash.bytes[slot]);
    return !flash.broken;
}

static inline bool flash_program(void *context, uint8_t slot, uint32_t offset, const uint8_t *bytes,
                                 uint32_t length)
{
    TEST_ASSERT_EQUAL_PTR(&flash, context);
    memcpy(&flash.bytes[slot][offset], bytes, length);
    return !flash.broken;
}

static const struct store_port FLASH = {
    .context = &flash, .read = flash_read, .erase = flash_erase, .program = flash_program};

static inline enum port_status wire_send(void *context, const struct can_frame_11bit *frame)
{
    TEST_ASSERT_EQUAL_PTR(&wire, context);
    if (wire.full && frame->id == SDO_ANSWER_ID) {
        return PORT_BUSY;
    }
    TEST_ASSERT_LESS_THAN_UINT(SDO_QUEUE, wire.sent_count);
    wire.sent[wire.sent_count++] = *frame;
    return PORT_OK;
}

static inline enum port_status wire_receive(void *context, struct can_frame_11bit *frame)
{
    TEST_ASSERT_EQUAL_PTR(&wire, context);
    if (wire.waiting_next >= wire.waiting_count) {
        wire.waiting_next = wire.waiting_count = 0;
        return PORT_EMPTY;
    }
    *frame = wire.waiting[wire.waiting_next++];
    return PORT_OK;
}

static inline uint32_t wire_now_us(void *context)
{
    (void)context;
    return 0;
}

/* Without and with a memory. */
static struct ecu_port the_port = {
    .context = &wire, .send = wire_send, .receive = wire_receive, .now_us = wire_now_us, .store = &FLASH};

static inline void queue(struct can_frame_11bit frame)
{
    TEST_ASSERT_LESS_THAN_UINT(SDO_QUEUE, wire.waiting_count);
    wire.waiting[wire.waiting_count++] = frame;
}

static inline void queue_nmt(uint8_t command)
{
    queue(nmt_frame(command, 1));
}

static inline void queue_request(uint8_t request, uint8_t controller)
{
    queue(motion_frame(request, 0, controller, 0, 1, wire.motion_counter));
    wire.motion_counter = (uint8_t)((wire.motion_counter + 1u) % E2E_COUNTER_STATES);
}

/* Both angles 0.1 rad, pressures that carry the arm with 3 kg. */
static inline void queue_sensors(void)
{
    const uint8_t counter = (uint8_t)((ecu.sync_counter - 1u) % E2E_COUNTER_STATES);
    queue(encoders_frame(267017, 267017, 0, counter));
    for (uint8_t i = 0; i < JOINTS; i++) {
        queue(pressures_frame(i, REST_PRESSURE[i], 0, 0, counter));
    }
}

static inline void tick(void)
{
    wire.sent_count = 0;
    ecu_tick_begin(&ecu, &the_port);
    if (!wire.silenced) {
        queue_sensors();
    }
    (void)ecu_tick_receive(&ecu, &the_port);
    ecu_tick_end(&ecu, &the_port);
}

static inline void ticks(unsigned count)
{
    for (unsigned k = 0; k < count; k++) {
        tick();
    }
}

static inline const struct can_frame_11bit *sent(uint32_t id)
{
    for (unsigned k = 0; k < wire.sent_count; k++) {
        if (wire.sent[k].id == id) {
            return &wire.sent[k];
        }
    }
    return NULL;
}

static inline void power_on(void)
{
    uint16_t entry;
    memset(&wire, 0, sizeof wire);
    memset(&flash, 0xFF, sizeof flash.bytes);
    flash.broken = false;
    the_port.store = &FLASH;
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, NULL, 1000, &entry));
    tick();
}

static inline void to_standby(void)
{
    queue_nmt(1);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
}

static inline void to_run(void)
{
    to_standby();
    queue_request(2, CONTROLLER_DIARC);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

/* No sensors until the safe stop has ended in FAULT; then they are back. */
static inline void fall_silent(void)
{
    wire.silenced = true;
    for (int k = 0; k < 1000 && ecu.mode != MODE_FAULT; k++) {
        tick();
    }
    wire.silenced = false;
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_FAULT, ecu.mode);
}

static inline void to_fault(void)
{
    to_run();
    fall_silent();
}

/* ---- the client ---- */

/* One request, one tick; the answer, or NULL. Never two. */
static inline const uint8_t *ask(const uint8_t request[8])
{
    queue(sdo_frame(request));
    tick();
    const struct can_frame_11bit *const answer = sent(SDO_ANSWER_ID);
    if (answer == NULL) {
        return NULL;
    }
    unsigned answers = 0;
    for (unsigned k = 0; k < wire.sent_count; k++) {
        answers += wire.sent[k].id == SDO_ANSWER_ID ? 1u : 0u;
    }
    TEST_ASSERT_EQUAL_UINT(1, answers);
    TEST_ASSERT_EQUAL_UINT8(8, answer->length);
    return answer->data;
}

static inline const uint8_t *ask_for(uint8_t command, uint16_t index, uint8_t sub, uint32_t data)
{
    uint8_t request[8];
    sdo_initiate(request, command, index, sub, data);
    const uint8_t *const answer = ask(request);
    TEST_ASSERT_NOT_NULL_MESSAGE(answer, "no answer");
    return answer;
}

static inline uint32_t u32_of(const uint8_t *b)
{
    return (uint32_t)b[0] | (uint32_t)b[1] << 8 | (uint32_t)b[2] << 16 | (uint32_t)b[3] << 24;
}

/* The abort code of an answer that must be one, and must name the object; 0 when it is none. */
static inline uint32_t abort_of(const uint8_t *answer, uint16_t index, uint8_t sub)
{
    if (answer[0] != 0x80u) {
        return 0;
    }
    TEST_ASSERT_EQUAL_HEX16(index, answer[1] | answer[2] << 8);
    TEST_ASSERT_EQUAL_HEX8(sub, answer[3]);
    return u32_of(&answer[4]);
}

/* What was read last. */
static struct {
    uint8_t bytes[SDO_BYTES];
    uint32_t length;
} got;

static inline uint32_t read_object(uint16_t index, uint8_t sub)
{
    const uint8_t *answer = ask_for(0x40, index, sub, 0);
    got.length = 0;
    if (answer[0] == 0x80u) {
        return abort_of(answer, index, sub);
    }
    TEST_ASSERT_EQUAL_HEX16(index, answer[1] | answer[2] << 8);
    TEST_ASSERT_EQUAL_HEX8(sub, answer[3]);
    if ((answer[0] & 2u) != 0u) {
        got.length = 4u - (answer[0] >> 2 & 3u);
        TEST_ASSERT_EQUAL_HEX8(0x43u | (4u - got.length) << 2, answer[0]);
        memcpy(got.bytes, &answer[4], 4);
        for (uint32_t k = got.length; k < 4u; k++) {
            TEST_ASSERT_EQUAL_HEX8_MESSAGE(0, answer[4 + k], "bytes past the value are not zero");
        }
        return 0;
    }
    TEST_ASSERT_EQUAL_HEX8(0x41, answer[0]);
    const uint32_t told = u32_of(&answer[4]);
    uint8_t toggle = 0;
    bool last = false;
    while (!last) {
        answer = ask_for((uint8_t)(0x60u | toggle), 0, 0, 0);
        if (answer[0] == 0x80u) {
            return abort_of(answer, index, sub);
        }
        TEST_ASSERT_EQUAL_HEX8(toggle, answer[0] & 0xF0u);
        const uint32_t length = 7u - (answer[0] >> 1 & 7u);
        TEST_ASSERT_LESS_OR_EQUAL_UINT32(SDO_BYTES, got.length + length);
        memcpy(&got.bytes[got.length], &answer[1], length);
        got.length += length;
        last = (answer[0] & 1u) != 0u;
        toggle ^= 0x10u;
    }
    TEST_ASSERT_EQUAL_UINT32(told, got.length);
    return 0;
}

static inline uint32_t number(uint16_t index, uint8_t sub)
{
    TEST_ASSERT_EQUAL_HEX32(0, read_object(index, sub));
    TEST_ASSERT_LESS_OR_EQUAL_UINT32(4, got.length);
    uint32_t value = 0;
    for (uint32_t k = 0; k < got.length; k++) {
        value |= (uint32_t)got.bytes[k] << (8u * k);
    }
    return value;
}

static inline double real32(uint16_t index)
{
    const uint32_t bits = number(index, 0);
    float value;
    TEST_ASSERT_EQUAL_UINT32(4, got.length);
    memcpy(&value, &bits, sizeof value);
    return (double)value;
}

static inline uint32_t bits_of(double value)
{
    const float single = (float)value;
    uint32_t bits;
    memcpy(&bits, &single, sizeof bits);
    return bits;
}

static inline uint32_t write_number(uint16_t index, uint8_t sub, uint32_t value, uint8_t length)
{
    const uint8_t *const answer = ask_for((uint8_t)(0x23u | (4u - length) << 2), index, sub, value);
    if (answer[0] == 0x60u) {
        TEST_ASSERT_EQUAL_HEX16(index, answer[1] | answer[2] << 8);
        TEST_ASSERT_EQUAL_HEX8(sub, answer[3]);
        return 0;
    }
    return abort_of(answer, index, sub);
}

/* In segments, `most` of them at most. */
static inline uint32_t write_segments(uint16_t index, uint8_t sub, const uint8_t *bytes, uint32_t length,
                                      uint32_t most)
{
    const uint8_t *answer = ask_for(0x21, index, sub, length);
    if (answer[0] == 0x80u) {
        return abort_of(answer, index, sub);
    }
    TEST_ASSERT_EQUAL_HEX8(0x60, answer[0]);
    uint8_t toggle = 0;
    for (uint32_t done = 0; done < length && most > 0u; most--) {
        const uint32_t count = length - done < 7u ? length - done : 7u;
        uint8_t request[8] = {(uint8_t)(toggle | (7u - count) << 1 | (done + count == length ? 1u : 0u))};
        memcpy(&request[1], &bytes[done], count);
        answer = ask(request);
        TEST_ASSERT_NOT_NULL(answer);
        if (answer[0] == 0x80u) {
            return abort_of(answer, index, sub);
        }
        TEST_ASSERT_EQUAL_HEX8(0x20u | toggle, answer[0]);
        done += count;
        toggle ^= 0x10u;
    }
    return 0;
}

#endif
