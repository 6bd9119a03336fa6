#include "ports/linux/options.h"

#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>

enum {
    PERIOD_MIN_US = 250,
    PERIOD_MAX_US = 20000,
    PERIOD_DEFAULT_US = 1000,
    PORT_MAX = 65535,
    INTERFACE_LENGTH_MAX = 15
};

static const char tcp_prefix[] = "tcp:";

__attribute__((format(printf, 1, 2))) static enum options_result complain(const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    (void)fputs("diarc_ecu: ", stderr);
    (void)vfprintf(stderr, format, arguments);
    (void)fputs("; see --help\n", stderr);
    va_end(arguments);
    return OPTIONS_ERROR;
}

/* Decimal digits only, min..max. Not strtoul: that takes blanks, signs and 2^64 - 1 for "-1". */
static bool parse_number(const char *text, uint32_t min, uint32_t max, uint32_t *number)
{
    uint64_t value = 0;
    if (text[0] == '\0') {
        return false;
    }
    for (const char *digit = text; *digit != '\0'; digit++) {
        if (*digit < '0' || *digit > '9') {
            return false;
        }
        value = value * 10 + (uint64_t)(*digit - '0');
        if (value > max) {
            return false;
        }
    }
    *number = (uint32_t)value;
    return value >= min;
}

static bool is_letter(char character)
{
    return (character >= 'a' && character <= 'z') || (character >= 'A' && character <= 'Z');
}

/* Only letters, digits, '.', '_' and '-', as for interfaces and hosts everywhere in this project. */
static bool is_name(const char *name)
{
    for (const char *c = name; *c != '\0'; c++) {
        if (!is_letter(*c) && !(*c >= '0' && *c <= '9') && *c != '.' && *c != '_' && *c != '-') {
            return false;
        }
    }
    return name[0] != '\0';
}

static bool is_interface(const char *name)
{
    return is_name(name) && is_letter(name[0]) && strlen(name) <= INTERFACE_LENGTH_MAX &&
           strcmp(name, "inproc") != 0; /* a bus of the Python side, where the ECU is a library */
}

/* Copies `length` characters and a zero; false when they do not fit or there are none. */
static bool copy_part(char *to, size_t to_bytes, const char *from, size_t length)
{
    if (length == 0 || length >= to_bytes) {
        return false;
    }
    memcpy(to, from, length);
    to[length] = '\0';
    return true;
}

static bool parse_tcp(const char *text, struct options *options)
{
    const char *const colon = strchr(text, ':');
    uint32_t port;
    return colon != NULL && copy_part(options->host, sizeof options->host, text, (size_t)(colon - text)) &&
           is_name(options->host) &&
           copy_part(options->port, sizeof options->port, colon + 1, strlen(colon + 1)) &&
           parse_number(options->port, 1, PORT_MAX, &port);
}

static enum options_result parse_bus(const char *text, struct options *options)
{
    if (options->bus != NULL) {
        return complain("one BUS only, got %s and %s", options->bus, text);
    }
    options->bus = text;
    options->is_tcp = strncmp(text, tcp_prefix, strlen(tcp_prefix)) == 0;
    if (options->is_tcp && !parse_tcp(text + strlen(tcp_prefix), options)) {
        return complain("BUS %s: expected tcp:HOST:PORT, PORT 1..%d", text, PORT_MAX);
    }
    if (!options->is_tcp && !is_interface(text)) {
        return complain(
            "BUS \"%s\": expected vcan0, can0, another interface of 1..15 characters, or tcp:HOST:PORT",
            text);
    }
    return OPTIONS_RUN;
}

static enum options_result parse_pace(const char *text, struct options *options)
{
    for (int pace = PACE_REALTIME; pace <= PACE_LOCKSTEP; pace++) {
        if (strcmp(text, pace_name((enum pace)pace)) == 0) {
            options->pace = (enum pace)pace;
            return OPTIONS_RUN;
        }
    }
    return complain("--pace %s: expected realtime, strict or lockstep", text);
}

static enum options_result parse_period(const char *text, struct options *options)
{
    if (!parse_number(text, PERIOD_MIN_US, PERIOD_MAX_US, &options->period_us)) {
        return complain("--period-us %s: expected a whole number, %d..%d", text, PERIOD_MIN_US,
                        PERIOD_MAX_US);
    }
    return OPTIONS_RUN;
}

static enum options_result parse_params(const char *text, struct options *options)
{
    if (text[0] == '\0') {
        return complain("--params: expected a file name");
    }
    options->params_path = text;
    return OPTIONS_RUN;
}

static enum options_result parse_store(const char *text, struct options *options)
{
    if (text[0] == '\0') {
        return complain("--store: expected a file name");
    }
    options->store_path = text;
    return OPTIONS_RUN;
}

static const struct {
    const char *name;
    const char *value;
    enum options_result (*parse)(const char *text, struct options *options);
} valued_flags[] = {
    {"--pace", "realtime, strict or lockstep", parse_pace},
    {"--period-us", "a whole number, 250..20000", parse_period},
    {"--params", "a file name", parse_params},
    {"--store", "a file name", parse_store},
};

/* "--flag VALUE" or "--flag=VALUE" at argv[*index]; moves *index to the last argument used. */
static enum options_result parse_valued(int argc, char *const argv[], int *index, struct options *options)
{
    const char *const argument = argv[*index];
    const size_t name_bytes = strcspn(argument, "=");
    for (size_t i = 0; i < sizeof valued_flags / sizeof valued_flags[0]; i++) {
        if (strlen(valued_flags[i].name) != name_bytes ||
            strncmp(argument, valued_flags[i].name, name_bytes) != 0) {
            continue;
        }
        if (argument[name_bytes] == '=') {
            return valued_flags[i].parse(argument + name_bytes + 1, options);
        }
        if (*index + 1 >= argc) {
            return complain("%s: the value is missing, expected %s", valued_flags[i].name,
                            valued_flags[i].value);
        }
        return valued_flags[i].parse(argv[++*index], options);
    }
    return complain("unknown flag %s", argument);
}

enum options_result options_parse(int argc, char *const argv[], struct options *options)
{
    memset(options, 0, sizeof *options);
    options->pace = PACE_REALTIME;
    options->period_us = PERIOD_DEFAULT_US;
    for (int i = 1; i < argc; i++) {
        enum options_result result = OPTIONS_RUN;
        if (strcmp(argv[i], "--help") == 0 || strcmp(argv[i], "-h") == 0) {
            result = OPTIONS_HELP;
        } else if (strcmp(argv[i], "--version") == 0) {
            result = OPTIONS_VERSION;
        } else if (strcmp(argv[i], "--quiet") == 0) {
            options->quiet = true;
        } else if (argv[i][0] == '-') {
            result = parse_valued(argc, argv, &i, options);
        } else {
            result = parse_bus(argv[i], options);
        }
        if (result != OPTIONS_RUN) {
            return result;
        }
    }
    return options->bus != NULL ? OPTIONS_RUN
                                : complain("BUS is missing, expected vcan0, can0 or tcp:HOST:PORT");
}

void options_print_help(void)
{
    (void)fputs(
        "usage: diarc_ecu BUS [--pace realtime|strict|lockstep] [--period-us N] [--params FILE] [--store "
        "FILE]\n"
        "                 [--quiet]\n"
        "\n"
        "The DIARC ECU: leads the CAN bus with SYNC, controls the hydraulic arm, stops with valves at zero.\n"
        "\n"
        "  BUS              an interface of the kernel, or a socketcand server (the simulated plant hosts "
        "one)\n"
        "  --pace realtime  SYNC on a timer, but not before the sensors have answered (default)\n"
        "  --pace strict    SYNC on the timer alone, as on the target; late and missing frames are faults\n"
        "  --pace lockstep  as fast as both sides can, same numbers as realtime\n"
        "  --period-us N    control period, 250..20000 us, default 1000\n"
        "  --params FILE    parameter image, default the built-in reference arm\n"
        "  --store FILE     where saved parameters survive; made if it is not there. A saved set wins over "
        "--params\n"
        "  --quiet          errors only\n"
        "  --help, --version\n"
        "\n"
        "examples:\n"
        "  diarc_ecu vcan0                        virtual CAN of the kernel\n"
        "  diarc_ecu can0 --pace strict           an adapter, 1 Mbit/s\n"
        "  diarc_ecu tcp:127.0.0.1:29536          socketcand, channel vcan0; no kernel driver needed\n"
        "\n"
        "SIGINT, SIGTERM and SIGHUP: safe stop, valves shut, end; a second one ends at once, valves shut.\n"
        "exit: 0 stopped by such a signal; 1 the bus is gone, or did not take the last valve frame; 2 wrong\n"
        "use, or the bus or the store cannot be opened\n",
        stdout);
}
