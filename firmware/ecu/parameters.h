/* The machine's parameters: one image of binary32 numbers in SI, the same for every number type, checked and
 * brought per unit here. The list itself is can_protocol/parameters.toml.
 *
 * Per unit: a machine names three bases as powers of two, for pressure p, cylinder area A and lever arm r;
 * angles, times and link lengths keep rad, s and m. All others follow: force p A, torque, mass and inertia
 * p A r, volume and flow A r, QL A, 1/be 1/p. Powers of two make the division exact in every number type. */
#ifndef ECU_PARAMETERS_H
#define ECU_PARAMETERS_H

#include "control/controller.h"
#include "ecu/generated/parameter_layout.h"

/* Little-endian: "DIAR", layout hash, exponents of p, A, r and a zero, the numbers, CRC-32 of all that. */
struct parameter_image {
    uint8_t bytes[PARAMETER_IMAGE_BYTES];
};

/* Binary logarithms of the bases. */
struct bases {
    int8_t pressure;
    int8_t area;
    int8_t lever;
};

enum ecu_status {
    ECU_OK,
    ECU_IMAGE_NOT_ONE,      /* no "DIAR" at the start */
    ECU_IMAGE_OTHER_LAYOUT, /* made for another list of parameters */
    ECU_IMAGE_DAMAGED,      /* CRC */
    ECU_IMAGE_BASES,        /* a base exponent outside its range, or odd where it must be even */
    ECU_PARAMETER_RANGE,    /* a number outside its range, or no number */
    ECU_PARAMETER_RELATION, /* it contradicts another: ends of a range swapped, rod thicker than bore, .. */
    ECU_PERIOD_RANGE        /* period outside 250..20000 us, or too long for the observer's bandwidth */
};

/* The image of the reference arm, built in. */
extern const struct parameter_image default_parameter_image;

/* Check the image and fill machine and bases; on any error both are left as they were. *entry is the number
 * of the offending parameter with ECU_PARAMETER_RANGE and ECU_PARAMETER_RELATION. */
enum ecu_status parameters_load(struct machine *machine, struct bases *bases,
                                const struct parameter_image *image, uint16_t *entry);

/* The same check without filling anything. */
enum ecu_status parameters_check(const struct parameter_image *image, uint16_t *entry);

/* False when the period is too long for the observer's bandwidth. */
bool parameters_suit_period(const struct parameter_image *image, scalar dt_s);

/* A parameter of a good image, binary32 in SI; entry < PARAMETER_COUNT. */
uint32_t parameters_get(const struct parameter_image *image, uint16_t entry);

enum parameter_change {
    PARAMETER_CHANGED,
    PARAMETER_TOO_LOW,
    PARAMETER_TOO_HIGH,
    PARAMETER_NOT_HELD,   /* no number, or too large for the number type with this machine's bases */
    PARAMETER_CONTRADICTS /* another parameter */
};

/* Change one parameter of a good image, which stays one; it is as it was when the number is refused. */
enum parameter_change parameters_set(struct parameter_image *image, uint16_t entry, uint32_t bits);

/* Exponent of a torque's, mass's and inertia's base; of a volume's and flow's. */
int8_t base_torque(const struct bases *bases);
int8_t base_volume(const struct bases *bases);

/* One line that says what is wrong and what to do; name of a parameter by its number. For ports with a
 * terminal: a microcontroller that never calls these does not link them. */
const char *ecu_status_text(enum ecu_status status);
const char *parameter_name(uint16_t entry);

#endif
