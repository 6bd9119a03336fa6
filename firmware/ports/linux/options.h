/* The command line of diarc_ecu. */
#ifndef PORTS_LINUX_OPTIONS_H
#define PORTS_LINUX_OPTIONS_H

#include <stdbool.h>
#include <stdint.h>

#include "ports/linux/loop.h"

enum {
    OPTIONS_HOST_BYTES = 254, /* the longest host name of the DNS, and a zero */
    OPTIONS_PORT_BYTES = 6    /* "65535" and a zero */
};

struct options {
    const char *bus; /* as given: an interface name, or tcp:HOST:PORT */
    bool is_tcp;     /* if so, the two parts of `bus` */
    char host[OPTIONS_HOST_BYTES];
    char port[OPTIONS_PORT_BYTES]; /* 1..65535 */
    enum pace pace;                /* default PACE_REALTIME */
    uint32_t period_us;            /* 250..20000, default 1000 */
    const char *params_path;       /* NULL: the built-in parameters */
    const char *store_path;        /* NULL: what is changed on the bus ends with the process */
    bool quiet;
};

enum options_result { OPTIONS_RUN, OPTIONS_HELP, OPTIONS_VERSION, OPTIONS_ERROR };

/* Reads the command line. OPTIONS_ERROR: one line on stderr has named the flag and its range. */
enum options_result options_parse(int argc, char *const argv[], struct options *options);

/* The text of --help, on stdout. */
void options_print_help(void);

#endif
