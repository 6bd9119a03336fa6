/* This board keeps no parameters: struct ecu_port's store is NULL, and the object dictionary refuses before it asks
 * for any of this. A board with a memory for them is built with DIARC_IMAGE_STORE, ecu/store.c, in place of this file. */
#include "ecu/store.h"

enum store_status store_load(const struct store_port *port, struct parameter_image *image)
{
    (void)port;
    (void)image;
    return STORE_EMPTY;
}

enum store_status store_save(const struct store_port *port, const struct parameter_image *image)
{
    (void)port;
    (void)image;
    return STORE_FAILED;
}

enum store_status store_restore_default(const struct store_port *port)
{
    (void)port;
    return STORE_FAILED;
}
