/* Words for people; kept apart so that a microcontroller does not carry them. */
#include "ecu/parameters.h"

static const char *const NAMES[PARAMETER_COUNT] = {
#include "ecu/generated/parameter_names.inc"
};

const char *parameter_name(uint16_t entry)
{
    return entry < PARAMETER_COUNT ? NAMES[entry] : "?";
}

const char *ecu_status_text(enum ecu_status status)
{
    switch (status) {
    case ECU_OK:
        return "no error";
    case ECU_IMAGE_NOT_ONE:
        return "is no parameter image (it does not begin with DIAR)";
    case ECU_IMAGE_OTHER_LAYOUT:
        return "was made for another list of parameters; make it again with this version's tools";
    case ECU_IMAGE_DAMAGED:
        return "is damaged (CRC); make it again";
    case ECU_IMAGE_BASES:
        return "has per-unit bases outside their ranges (can_protocol/parameters.toml)";
    case ECU_PARAMETER_RANGE:
        return "has a parameter outside its range (can_protocol/parameters.toml), or too large for fixed "
               "point with "
               "these bases";
    case ECU_PARAMETER_RELATION:
        return "has a parameter that contradicts another: ends of a range swapped, rod thicker than bore, a "
               "prior "
               "outside its bounds, or a crank at its dead point";
    case ECU_PERIOD_RANGE:
        return "the period must be 250..20000 us and below 1 / control.observer_rad_s";
    default:
        return "unknown status";
    }
}
