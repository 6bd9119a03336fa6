/* Parameters changed while the ECU runs: one by one, or all by an image that comes in pieces. Whatever happens, the
 * set in force is the old one or the new one, never a mixture.
 *
 * There is no room for a second image. The numbers of one that is coming are kept where the machine's are, which
 * follow from ecu->image: until it is taken or dropped THERE IS NO MACHINE, and nothing may look at it.
 * Only begin one while the valves are shut, and do not arm until it is over (parameter_set_coming). */
#ifndef ECU_PARAMETER_SET_H
#define ECU_PARAMETER_SET_H

#include <stdbool.h>
#include <stdint.h>

#include "ecu/parameters.h"

#define NO_PARAMETER 65535u

struct ecu;

/* What of an image that is coming is not among the machine's numbers: its header and its CRC. */
struct parameter_set_coming {
    bool open;
    uint16_t count; /* of bytes that have come */
    uint8_t frame[16];
};

/* Change one parameter and start the law anew with it; otherwise nothing has happened. */
enum parameter_change parameter_set_change(struct ecu *ecu, uint16_t entry, uint32_t bits);

bool parameter_set_coming(const struct ecu *ecu);
void parameter_set_begin(struct ecu *ecu);

/* False when more comes than an image has; drop it then. */
bool parameter_set_add(struct ecu *ecu, const uint8_t *bytes, uint8_t length);

/* All has come: check it, and start the law anew with it, or go on with the old one as if nothing had happened.
 * *entry is the offender as with parameters_load. */
enum ecu_status parameter_set_take(struct ecu *ecu, uint16_t *entry);

/* Back to the old set. Does nothing when no image is coming. */
void parameter_set_drop(struct ecu *ecu);

#endif
