/* A CAN interface of the Linux kernel (vcan0, can0) as a bus. */
#ifndef PORTS_LINUX_SOCKETCAN_H
#define PORTS_LINUX_SOCKETCAN_H

#include <stdbool.h>

#include "ports/linux/bus.h"

/* Opens `interface` for 11 bit data frames and fills *bus. False: bus->message has one line that says what is
 * missing and the command that helps; nothing is left open. `interface` must outlive the bus. */
bool socketcan_open(struct bus *bus, const char *interface);

#endif
