/* The faults and what follows from each. The table is made from can_protocol/faults.toml. */
#ifndef ECU_FAULTS_H
#define ECU_FAULTS_H

#include <stdbool.h>
#include <stdint.h>

#include "ecu/generated/fault_codes.h"
#include "ecu/port.h"

struct ecu;

enum fault_reaction {
    REACTION_DEGRADE,   /* the estimate is held; leaves by itself */
    REACTION_SAFE_STOP, /* SAFE_STOP, then FAULT */
    REACTION_VALVES_OFF /* FAULT at once */
};

struct fault_row {
    uint16_t emergency;     /* CiA 301 error code */
    uint8_t error_register; /* bits of 1001h */
    uint8_t reaction;       /* enum fault_reaction */
};

extern const struct fault_row fault_table[FAULTS];

/* The fault has come: EMCY, then its reaction. Nothing while it is active already. */
void fault_raise(struct ecu *ecu, const struct ecu_port *port, enum ecu_fault fault);

/* A fault whose reaction is to degrade has gone. Nothing while it is not active. */
void fault_clear(struct ecu *ecu, const struct ecu_port *port, enum ecu_fault fault);

/* All of them: RESET_FAULT has been granted. */
void fault_clear_all(struct ecu *ecu, const struct ecu_port *port);

bool fault_active(const struct ecu *ecu, enum ecu_fault fault);

/* One is active whose reaction is more than to degrade. */
bool fault_stops(const struct ecu *ecu);

/* Error register 1001h of all active faults. */
uint8_t fault_error_register(const struct ecu *ecu);

#endif
