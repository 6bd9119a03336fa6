#include "ecu/faults.h"

#include "ecu/ecu.h"
#include "ecu/operation.h"
#include "ecu/transmit.h"

const struct fault_row fault_table[FAULTS] = {
#include "ecu/generated/fault_table.inc"
};

#define GENERIC_ERROR 0x01u /* set with every other bit, CiA 301 */

static uint32_t bit_of(enum ecu_fault fault)
{
    return UINT32_C(1) << (uint32_t)fault;
}

bool fault_active(const struct ecu *ecu, enum ecu_fault fault)
{
    return (ecu->active_faults & bit_of(fault)) != 0u;
}

static bool any_active(const struct ecu *ecu, bool degrading)
{
    for (uint8_t k = 1; k < (uint8_t)FAULTS; k++) {
        const bool degrades = fault_table[k].reaction == (uint8_t)REACTION_DEGRADE;
        if (fault_active(ecu, (enum ecu_fault)k) && degrades == degrading) {
            return true;
        }
    }
    return false;
}

bool fault_stops(const struct ecu *ecu)
{
    return any_active(ecu, false);
}

uint8_t fault_error_register(const struct ecu *ecu)
{
    uint8_t bits = 0;
    for (uint8_t k = 1; k < (uint8_t)FAULTS; k++) {
        if (fault_active(ecu, (enum ecu_fault)k)) {
            bits |= (uint8_t)(fault_table[k].error_register | GENERIC_ERROR);
        }
    }
    return bits;
}

static void send_emergency(struct ecu *ecu, const struct ecu_port *port, enum ecu_fault fault)
{
    emergency_note(&ecu->emergencies, fault_table[fault].emergency, (uint8_t)fault);
    (void)transmit_send(ecu, port, transmit_emergency(ecu, fault));
}

/* The one that TIMING shows: the first to come, and when it is gone any other. */
static void choose_shown(struct ecu *ecu)
{
    if (ecu->fault != FAULT_NONE && fault_active(ecu, ecu->fault)) {
        return;
    }
    ecu->fault = FAULT_NONE;
    for (uint8_t k = 1; k < (uint8_t)FAULTS && ecu->fault == FAULT_NONE; k++) {
        if (fault_active(ecu, (enum ecu_fault)k)) {
            ecu->fault = (enum ecu_fault)k;
        }
    }
}

void fault_raise(struct ecu *ecu, const struct ecu_port *port, enum ecu_fault fault)
{
    if (fault == FAULT_NONE || fault_active(ecu, fault)) {
        return;
    }
    ecu->active_faults |= bit_of(fault);
    /* what stops the arm is shown before what only degrades it */
    const bool stops = fault_table[fault].reaction != (uint8_t)REACTION_DEGRADE;
    if (ecu->fault == FAULT_NONE ||
        (stops && fault_table[ecu->fault].reaction == (uint8_t)REACTION_DEGRADE)) {
        ecu->fault = fault;
    }
    send_emergency(ecu, port, fault);
    switch ((enum fault_reaction)fault_table[fault].reaction) {
    case REACTION_SAFE_STOP:
        (void)operation_event(ecu, EVENT_FAULT_STOP);
        break;
    case REACTION_VALVES_OFF:
        (void)operation_event(ecu, EVENT_FAULT_OFF);
        break;
    case REACTION_DEGRADE:
    default:
        ecu->controller.estimator.held = true;
        break;
    }
}

static void after_clearing(struct ecu *ecu, const struct ecu_port *port)
{
    choose_shown(ecu);
    ecu->controller.estimator.held = any_active(ecu, true);
    if (ecu->active_faults == 0u) {
        send_emergency(ecu, port, FAULT_NONE);
    }
}

void fault_clear(struct ecu *ecu, const struct ecu_port *port, enum ecu_fault fault)
{
    if (fault_active(ecu, fault)) {
        ecu->active_faults &= ~bit_of(fault);
        after_clearing(ecu, port);
    }
}

void fault_clear_all(struct ecu *ecu, const struct ecu_port *port)
{
    ecu->active_faults = 0;
    after_clearing(ecu, port);
}
