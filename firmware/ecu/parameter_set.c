#include "ecu/parameter_set.h"

#include "ecu/ecu.h"

#define HEADER_BYTES 12u
#define NUMBER_BYTES (4u * PARAMETER_COUNT)

_Static_assert(HEADER_BYTES + NUMBER_BYTES + 4u == PARAMETER_IMAGE_BYTES, "header, numbers, CRC");
_Static_assert(sizeof(struct machine) >= NUMBER_BYTES, "the machine makes room for an image's numbers");
_Static_assert(sizeof((struct parameter_set_coming *)0)->frame == PARAMETER_IMAGE_BYTES - NUMBER_BYTES,
               "room for the rest of an image");

/* The machine, the bases and the constants from the image, which is a good one; the law from its start. */
static void start_anew(struct ecu *ecu)
{
    const struct bases before = ecu->bases;
    uint16_t entry = 0;
    (void)parameters_load(&ecu->machine, &ecu->bases, &ecu->image, &entry);
    controller_constants(&ecu->constants, &ecu->machine, ecu->constants.dt_s);
    const bool held = ecu->controller.estimator.held; /* follows from the active faults, not from the set */
    controller_start(&ecu->controller, &ecu->machine, &ecu->constants);
    ecu->controller.estimator.held = held;
    supervision_start(ecu);
    if (ecu->bases.pressure != before.pressure) {
        ecu->tare = (struct tare){0}; /* its offsets were per unit of another base */
    }
}

enum parameter_change parameter_set_change(struct ecu *ecu, uint16_t entry, uint32_t bits)
{
    const uint32_t before = parameters_get(&ecu->image, entry);
    enum parameter_change change = parameters_set(&ecu->image, entry, bits);
    if (change == PARAMETER_CHANGED && !parameters_suit_period(&ecu->image, ecu->constants.dt_s)) {
        (void)parameters_set(&ecu->image, entry, before);
        change = PARAMETER_CONTRADICTS;
    }
    if (change == PARAMETER_CHANGED) {
        start_anew(ecu);
    }
    return change;
}

bool parameter_set_coming(const struct ecu *ecu)
{
    return ecu->coming.open;
}

void parameter_set_begin(struct ecu *ecu)
{
    ecu->coming.open = true;
    ecu->coming.count = 0;
}

/* Where byte k of the image that is coming is kept. */
static uint8_t *place_of(struct ecu *ecu, uint16_t k)
{
    if (k < HEADER_BYTES) {
        return &ecu->coming.frame[k];
    }
    if (k < HEADER_BYTES + NUMBER_BYTES) {
        return (uint8_t *)&ecu->machine + (k - HEADER_BYTES);
    }
    return &ecu->coming.frame[k - NUMBER_BYTES];
}

bool parameter_set_add(struct ecu *ecu, const uint8_t *bytes, uint8_t length)
{
    if (length > PARAMETER_IMAGE_BYTES - ecu->coming.count) {
        return false;
    }
    for (uint8_t k = 0; k < length; k++) {
        *place_of(ecu, ecu->coming.count) = bytes[k];
        ecu->coming.count++;
    }
    return true;
}

/* The image that has come and the one in force change places. */
static void swap(struct ecu *ecu)
{
    for (uint16_t k = 0; k < PARAMETER_IMAGE_BYTES; k++) {
        uint8_t *const place = place_of(ecu, k);
        const uint8_t byte = *place;
        *place = ecu->image.bytes[k];
        ecu->image.bytes[k] = byte;
    }
}

enum ecu_status parameter_set_take(struct ecu *ecu, uint16_t *entry)
{
    *entry = 0;
    if (ecu->coming.count != PARAMETER_IMAGE_BYTES) {
        parameter_set_drop(ecu);
        return ECU_IMAGE_NOT_ONE;
    }
    swap(ecu);
    enum ecu_status status = parameters_check(&ecu->image, entry);
    if (status == ECU_OK && !parameters_suit_period(&ecu->image, ecu->constants.dt_s)) {
        status = ECU_PERIOD_RANGE;
    }
    if (status != ECU_OK) {
        swap(ecu);
        parameter_set_drop(ecu);
        return status;
    }
    ecu->coming.open = false;
    start_anew(ecu);
    return ECU_OK;
}

void parameter_set_drop(struct ecu *ecu)
{
    if (ecu->coming.open) {
        uint16_t entry = 0;
        (void)parameters_load(&ecu->machine, &ecu->bases, &ecu->image, &entry);
        ecu->coming.open = false;
    }
}
