/* Raw integers of the frames to per-unit scalars and back. The scales come from the DBC through
 * generated/diarc_scales.h; `base` is the binary logarithm of the quantity's base. */
#ifndef ECU_WIRE_H
#define ECU_WIRE_H

#include "can_protocol/generated/diarc_scales.h"
#include "control/scalar.h"

/* The most negative (signed) or the highest (unsigned) raw value means "invalid". */
#define WIRE_INVALID_S24 (-8388607 - 1)
#define WIRE_INVALID_S16 (-32767 - 1)
#define WIRE_INVALID_U16 65535
#define WIRE_MAX_S24 8388607
#define WIRE_MAX_S20 524287
#define WIRE_MAX_U16 65535
#define WIRE_MAX_SPOOL 16384

/* raw * mantissa * 2^(exponent - base) */
static inline scalar wire_decode(int32_t raw, scalar mantissa, int8_t exponent, int8_t base)
{
    return mul(scalar_from_raw(raw, (uint8_t)(base - exponent)), mantissa);
}

/* The same of few bits and base 0, |raw * 2^exponent| < 16: what comes every tick. */
static inline scalar wire_decode_small(int32_t raw, scalar mantissa, int8_t exponent)
{
    return mul(scalar_from_small(raw, (uint8_t)-exponent), mantissa);
}

/* x * mantissa * 2^(exponent + base), rounded half away from zero, limited to low..high */
static inline int32_t wire_encode(scalar x, scalar mantissa, int8_t exponent, int8_t base, int32_t low,
                                  int32_t high)
{
    return scalar_to_raw(mul(x, mantissa), (uint8_t)(exponent + base), low, high);
}

/* signal: its name in diarc_scales.h without _STEP_.. */
#define WIRE_DECODE(raw, signal, base) \
    wire_decode((raw), SCALAR(signal##_STEP_MANTISSA), signal##_STEP_EXPONENT, (base))
#define WIRE_DECODE_SMALL(raw, signal) \
    wire_decode_small((raw), SCALAR(signal##_STEP_MANTISSA), signal##_STEP_EXPONENT)
#define WIRE_ENCODE(x, signal, base, low, high) \
    wire_encode((x), SCALAR(signal##_PER_STEP_MANTISSA), signal##_PER_STEP_EXPONENT, (base), (low), (high))

#endif
