#include "ecu/parameters.h"

#include <stddef.h>

#include "ecu/crc32.h"
#include "ecu/little_endian.h"

enum parameter_kind { PARAMETER_SCALAR, PARAMETER_GAIN };

struct parameter_quantity {
    uint8_t kind;        /* enum parameter_kind */
    int8_t exponents[3]; /* twice that of pressure, twice that of area, that of the lever arm */
};

struct parameter_entry {
    uint8_t field;     /* in struct machine */
    uint8_t quantity;  /* in QUANTITIES */
    uint8_t low, high; /* in LIMITS */
};

/* All of struct machine is numbers of one size: this many of them are before a field. */
#define FIELD(name) ((uint8_t)(offsetof(struct machine, name) / sizeof(scalar)))
_Static_assert(sizeof(scalar) == sizeof(gain), "fields are counted in numbers of one size");
_Static_assert(sizeof(struct machine) / sizeof(scalar) <= UINT8_MAX, "a field's number is one byte");

static const struct parameter_entry TABLE[PARAMETER_COUNT] = {
#include "ecu/generated/parameter_table.inc"
};

static const struct parameter_quantity QUANTITIES[] = {
#include "ecu/generated/parameter_quantities.inc"
};

/* binary32, SI */
static const uint32_t LIMITS[] = {
#include "ecu/generated/parameter_limits.inc"
};

const struct parameter_image default_parameter_image = {{
#include "ecu/generated/default_image.inc"
}};

#define HEADER_BYTES 12u
#define CRC_AT (PARAMETER_IMAGE_BYTES - 4u)

/* binary32 bits as an integer that sorts as the numbers do; -0 equals 0. */
static int32_t real32_order(uint32_t bits)
{
    const int32_t magnitude = (int32_t)(bits & 0x7FFFFFFFu);
    return (bits >> 31) != 0u ? -magnitude : magnitude;
}

static bool real32_is_number(uint32_t bits)
{
    return (bits & 0x7F800000u) != 0x7F800000u;
}

static bool within(int16_t value, int16_t low, int16_t high)
{
    return value >= low && value <= high;
}

static bool bases_valid(const struct bases *bases)
{
    return within(bases->pressure, BASE_PRESSURE_LOW, BASE_PRESSURE_HIGH) && bases->pressure % 2 == 0 &&
           within(bases->area, BASE_AREA_LOW, BASE_AREA_HIGH) && bases->area % 2 == 0 &&
           within(bases->lever, BASE_LEVER_LOW, BASE_LEVER_HIGH) &&
           within(base_torque(bases), BASE_TORQUE_LOW, BASE_TORQUE_HIGH);
}

static int8_t base_of(const struct parameter_quantity *quantity, const struct bases *bases)
{
    return (int8_t)(quantity->exponents[0] * (bases->pressure / 2) +
                    quantity->exponents[1] * (bases->area / 2) + quantity->exponents[2] * bases->lever);
}

/* Pairs of parameters of which the first must be below the second; for a prior's value equal will do. */
struct parameter_relation {
    uint8_t lower, higher; /* fields */
    bool may_be_equal;
};

#define BELOW(a, b)               \
    {                             \
        FIELD(a), FIELD(b), false \
    }
#define PRIOR(name)                                                         \
    BELOW(name.low, name.high), {FIELD(name.low), FIELD(name.value), true}, \
    {                                                                       \
        FIELD(name.value), FIELD(name.high), true                           \
    }

static const struct parameter_relation RELATIONS[] = {
    BELOW(supply.p_tank, supply.p_supply),
    BELOW(cylinder[SWING].rod, cylinder[SWING].bore),
    BELOW(cylinder[WRIST].rod, cylinder[WRIST].bore),
    BELOW(cylinder[SWING].q_min, cylinder[SWING].q_max),
    BELOW(cylinder[WRIST].q_min, cylinder[WRIST].q_max),
    PRIOR(estimator.m[M_T]),
    PRIOR(estimator.m[J]),
    PRIOR(estimator.m[M2]),
    PRIOR(estimator.m[FV1]),
    PRIOR(estimator.m[FV2]),
    PRIOR(estimator.m[FC1]),
    PRIOR(estimator.m[FC2]),
    PRIOR(estimator.m[OM1]),
    PRIOR(estimator.m[OM2]),
    PRIOR(estimator.h[BETA_INVERSE]),
    PRIOR(estimator.h[OM2_SWING]),
    PRIOR(estimator.h[OM3_SWING]),
    PRIOR(estimator.h[OM2_WRIST]),
    PRIOR(estimator.h[OM3_WRIST]),
};

/* The crank's triangle stays this far from its dead points, rad. */
#define TRIANGLE_LOW SCALAR(0.05)
#define TRIANGLE_HIGH SCALAR(3.09)

uint32_t parameters_get(const struct parameter_image *image, uint16_t entry)
{
    return get_u32(&image->bytes[HEADER_BYTES + 4u * entry]);
}

/* The entry that fills a field; every field has one. */
static uint16_t entry_of(uint8_t field)
{
    uint16_t k = 0;
    while (k < PARAMETER_COUNT - 1 && TABLE[k].field != field) {
        k++;
    }
    return k;
}

static scalar angle_of(const struct parameter_image *image, uint8_t field)
{
    return scalar_from_real32(parameters_get(image, entry_of(field)), 0);
}

/* False, and *entry the offender, when two parameters contradict one another. */
static bool relations_hold(const struct parameter_image *image, uint16_t *entry)
{
    for (uint8_t n = 0; n < sizeof RELATIONS / sizeof RELATIONS[0]; n++) {
        const uint16_t lower = entry_of(RELATIONS[n].lower);
        const int32_t low = real32_order(parameters_get(image, lower));
        const int32_t high = real32_order(parameters_get(image, entry_of(RELATIONS[n].higher)));
        if (low > high || (low == high && !RELATIONS[n].may_be_equal)) {
            *entry = lower;
            return false;
        }
    }
    static const uint8_t ends[JOINTS][3] = {
        {FIELD(cylinder[SWING].q0), FIELD(cylinder[SWING].q_min), FIELD(cylinder[SWING].q_max)},
        {FIELD(cylinder[WRIST].q0), FIELD(cylinder[WRIST].q_min), FIELD(cylinder[WRIST].q_max)},
    };
    for (uint8_t i = 0; i < JOINTS; i++) {
        const scalar q0 = angle_of(image, ends[i][0]);
        if (angle_of(image, ends[i][1]) + q0 < TRIANGLE_LOW ||
            angle_of(image, ends[i][2]) + q0 > TRIANGLE_HIGH) {
            *entry = entry_of(ends[i][0]);
            return false;
        }
    }
    return true;
}

/* Whether a number may stand at this place: inside its limits, and held by the number type. */
static enum parameter_change number_fits(uint16_t entry, uint32_t bits, const struct bases *bases)
{
    const struct parameter_entry *const row = &TABLE[entry];
    const struct parameter_quantity *const quantity = &QUANTITIES[row->quantity];
    if (!real32_is_number(bits)) {
        return PARAMETER_NOT_HELD;
    }
    if (real32_order(bits) < real32_order(LIMITS[row->low])) {
        return PARAMETER_TOO_LOW;
    }
    if (real32_order(bits) > real32_order(LIMITS[row->high])) {
        return PARAMETER_TOO_HIGH;
    }
    const int8_t exponent = base_of(quantity, bases);
    const bool held = quantity->kind == (uint8_t)PARAMETER_GAIN ? gain_holds_real32(bits, exponent)
                                                                : scalar_holds_real32(bits, exponent);
    return held ? PARAMETER_CHANGED : PARAMETER_NOT_HELD;
}

static struct bases image_bases(const struct parameter_image *image)
{
    return (struct bases){(int8_t)image->bytes[8], (int8_t)image->bytes[9], (int8_t)image->bytes[10]};
}

enum ecu_status parameters_check(const struct parameter_image *image, uint16_t *entry)
{
    const uint8_t *const bytes = image->bytes;
    *entry = 0;
    if (bytes[0] != (uint8_t)'D' || bytes[1] != (uint8_t)'I' || bytes[2] != (uint8_t)'A' ||
        bytes[3] != (uint8_t)'R') {
        return ECU_IMAGE_NOT_ONE;
    }
    if (get_u32(&bytes[4]) != PARAMETER_LAYOUT_HASH) {
        return ECU_IMAGE_OTHER_LAYOUT;
    }
    if (crc32_add(CRC32_START, bytes, CRC_AT) != get_u32(&bytes[CRC_AT])) {
        return ECU_IMAGE_DAMAGED;
    }
    const struct bases found = image_bases(image);
    if (!bases_valid(&found)) {
        return ECU_IMAGE_BASES;
    }
    for (uint16_t k = 0; k < PARAMETER_COUNT; k++) {
        if (number_fits(k, parameters_get(image, k), &found) != PARAMETER_CHANGED) {
            *entry = k;
            return ECU_PARAMETER_RANGE;
        }
    }
    return relations_hold(image, entry) ? ECU_OK : ECU_PARAMETER_RELATION;
}

enum ecu_status parameters_load(struct machine *machine, struct bases *bases,
                                const struct parameter_image *image, uint16_t *entry)
{
    const enum ecu_status status = parameters_check(image, entry);
    if (status != ECU_OK) {
        return status;
    }
    *bases = image_bases(image);
    for (uint16_t k = 0; k < PARAMETER_COUNT; k++) {
        const uint32_t bits = parameters_get(image, k);
        const struct parameter_quantity *const quantity = &QUANTITIES[TABLE[k].quantity];
        const int8_t exponent = base_of(quantity, bases);
        uint8_t *const field = (uint8_t *)machine + TABLE[k].field * sizeof(scalar);
        if (quantity->kind == (uint8_t)PARAMETER_GAIN) {
            *(gain *)(void *)field = gain_from_real32(bits, exponent);
        } else {
            *(scalar *)(void *)field = scalar_from_real32(bits, exponent);
        }
    }
    return ECU_OK;
}

bool parameters_suit_period(const struct parameter_image *image, scalar dt_s)
{
    const uint32_t bits = parameters_get(image, entry_of(FIELD(observer_bandwidth)));
    return amp(gain_from_real32(bits, 0), dt_s) < SCALAR(1);
}

enum parameter_change parameters_set(struct parameter_image *image, uint16_t entry, uint32_t bits)
{
    const struct bases bases = image_bases(image);
    const enum parameter_change fits = number_fits(entry, bits, &bases);
    if (fits != PARAMETER_CHANGED) {
        return fits;
    }
    uint8_t *const place = &image->bytes[HEADER_BYTES + 4u * entry];
    const uint32_t before = get_u32(place);
    uint16_t other = 0;
    put_u32(place, bits);
    if (!relations_hold(image, &other)) {
        put_u32(place, before);
        return PARAMETER_CONTRADICTS;
    }
    put_u32(&image->bytes[CRC_AT], crc32_add(CRC32_START, image->bytes, CRC_AT));
    return PARAMETER_CHANGED;
}

int8_t base_torque(const struct bases *bases)
{
    return (int8_t)(bases->pressure + bases->area + bases->lever);
}

int8_t base_volume(const struct bases *bases)
{
    return (int8_t)(bases->area + bases->lever);
}
