/* A change of mode and what it does to the law: the table of modes.h, carried out. */
#ifndef ECU_OPERATION_H
#define ECU_OPERATION_H

#include "ecu/modes.h"

struct ecu;

/* Go where the table leads; nothing changes with a refusal. Entering a driving mode needs this tick's samples. */
enum ecu_refusal operation_event(struct ecu *ecu, enum ecu_event event);

/* One tick of SAFE_STOP: the ramp's set-points; in other modes nothing. */
void operation_step(struct ecu *ecu);

#endif
