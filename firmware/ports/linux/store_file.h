/* The parameter store in a file: one ECU's, locked while it runs. */
#ifndef PORTS_LINUX_STORE_FILE_H
#define PORTS_LINUX_STORE_FILE_H

#include <stdbool.h>

#include "ecu/store.h"

enum { STORE_FILE_MESSAGE_BYTES = 1024 };

struct store_file {
    struct store_port port; /* valid while the struct stays where it is */
    int fd;
    char message[STORE_FILE_MESSAGE_BYTES]; /* one line, no newline; after a failed open */
};

/* Opens the file, which only its owner may read and write when it is made here. False, with a message: it cannot be
 * opened, another process has it, or it holds something that is no store; it is then left as it was. */
bool store_file_open(struct store_file *file, const char *path);

void store_file_close(struct store_file *file);

#endif
