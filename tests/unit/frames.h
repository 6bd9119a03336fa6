/* Frames bit by bit, by hand and not by the code made from the DBC: what the I/O node, a master and an SDO client put on
 * the bus. For unit tests and fuzzing. */
#ifndef TESTS_FRAMES_H
#define TESTS_FRAMES_H

#include <stdint.h>
#include <string.h>

#include "control/arm_model.h"
#include "control/hydraulics.h"
#include "ecu/e2e.h"
#include "ecu/port.h"

/* A signal of `length` bits from bit `start` on, as the DBC numbers them for little-endian signals. */
static inline void put_bits(uint8_t data[8], unsigned start, unsigned length, int64_t value)
{
    for (unsigned k = 0; k < length; k++) {
        const unsigned bit = start + k;
        const uint8_t mask = (uint8_t)(1u << (bit % 8u));
        data[bit / 8u] = (uint8_t)(data[bit / 8u] & ~mask);
        if ((((uint64_t)value >> k) & 1u) != 0u) {
            data[bit / 8u] = (uint8_t)(data[bit / 8u] | mask);
        }
    }
}

static inline uint32_t get_bits(const uint8_t data[8], unsigned start, unsigned length)
{
    uint64_t value = 0;
    for (unsigned k = 0; k < length; k++) {
        const unsigned bit = start + k;
        value |= (uint64_t)((data[bit / 8u] >> (bit % 8u)) & 1u) << k;
    }
    return (uint32_t)value;
}

static inline int32_t get_signed(const uint8_t data[8], unsigned start, unsigned length)
{
    const int64_t value = get_bits(data, start, length);
    return (int32_t)((value >> (length - 1u)) != 0 ? value - ((int64_t)1 << length) : value);
}

/* A frame of 8 bytes of zeros with good protection. */
static inline struct can_frame_11bit protected_frame(uint16_t id, uint8_t counter)
{
    struct can_frame_11bit frame = {.id = id, .length = 8};
    e2e_protect(id, counter, frame.data);
    return frame;
}

/* An arm that rests at 0.1 rad with 3 kg: its pressures as frames have them, in steps of 5 mbar. */
static const uint16_t REST_PRESSURE[JOINTS][CHAMBERS] = {{10000, 14628}, {8412, 10000}};

/* Angles, pressures and spools are raw; `counter` is that of the SYNC which the frame answers. */
static inline struct can_frame_11bit encoders_frame(int32_t swing, int32_t wrist, uint8_t status,
                                                    uint8_t counter)
{
    struct can_frame_11bit frame = {.id = 0x182, .length = 8};
    put_bits(frame.data, 12, 4, status);
    put_bits(frame.data, 16, 24, swing);
    put_bits(frame.data, 40, 24, wrist);
    e2e_protect(0x182, counter, frame.data);
    return frame;
}

static inline struct can_frame_11bit pressures_frame(uint8_t joint, const uint16_t pressure[CHAMBERS],
                                                     int16_t spool, uint8_t status, uint8_t counter)
{
    const uint16_t id = joint == SWING ? 0x282 : 0x382;
    struct can_frame_11bit frame = {.id = id, .length = 8};
    put_bits(frame.data, 12, 4, status);
    put_bits(frame.data, 16, 16, pressure[BORE]);
    put_bits(frame.data, 32, 16, pressure[ANNULUS]);
    put_bits(frame.data, 48, 16, spool);
    e2e_protect(id, counter, frame.data);
    return frame;
}

/* A master's request; the target is raw. */
static inline struct can_frame_11bit motion_frame(uint8_t request, uint8_t joint, uint8_t controller,
                                                  int32_t target, uint16_t duration_ms, uint8_t counter)
{
    struct can_frame_11bit frame = {.id = 0x201, .length = 8};
    put_bits(frame.data, 16, 4, request);
    put_bits(frame.data, 20, 2, joint);
    put_bits(frame.data, 22, 2, controller);
    put_bits(frame.data, 24, 24, target);
    put_bits(frame.data, 48, 16, duration_ms);
    e2e_protect(0x201, counter, frame.data);
    return frame;
}

static inline struct can_frame_11bit nmt_frame(uint8_t command, uint8_t node)
{
    return (struct can_frame_11bit){.id = 0, .length = 2, .data = {command, node}};
}

/* What an SDO client sends to node 1: bytes as they are, or the begin of a transfer. */
static inline struct can_frame_11bit sdo_frame(const uint8_t request[8])
{
    struct can_frame_11bit frame = {.id = 0x601, .length = 8};
    memcpy(frame.data, request, 8);
    return frame;
}

static inline void sdo_initiate(uint8_t request[8], uint8_t command, uint16_t index, uint8_t sub,
                                uint32_t data)
{
    request[0] = command;
    request[1] = (uint8_t)index;
    request[2] = (uint8_t)(index >> 8);
    request[3] = sub;
    for (uint32_t k = 0; k < 4u; k++) {
        request[4u + k] = (uint8_t)(data >> (8u * k));
    }
}

#endif
