/* diarc_ecu: the ECU as a Linux process. */
#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>

#include "ecu/ecu.h"
#include "ecu/parameters.h"
#include "ports/linux/loop.h"
#include "ports/linux/options.h"
#include "ports/linux/realtime.h"
#include "ports/linux/socketcan.h"
#include "ports/linux/socketcand_client.h"
#include "ports/linux/store_file.h"

#ifndef DIARC_VERSION
#error "the build defines DIARC_VERSION, a string"
#endif

enum { EXIT_RUN_FAILED = 1, EXIT_WRONG_USE = 2 };

/* The bus asked for at a socketcand server: the hub takes any name, a daemon must have this interface. */
#define SOCKETCAND_CHANNEL "vcan0"

/* Static: no heap, and too large for a stack that strict pace locks in memory. */
static struct ecu the_ecu;
static struct parameter_image the_image;
static struct socketcan socketcan_bus;
static struct parameter_image stored_image;
static struct store_file the_store;
static struct socketcand_client socketcand_bus;

/* Reads exactly one image; false after one line on stderr. */
static bool read_image(const char *path, struct parameter_image *image)
{
    FILE *const file = fopen(path, "rb");
    if (file == NULL) {
        (void)fprintf(stderr, "diarc_ecu: --params %s: %s; expected a parameter image of %zu bytes\n", path,
                      strerror(errno), sizeof image->bytes);
        return false;
    }
    errno = 0;
    const size_t count = fread(image->bytes, 1, sizeof image->bytes, file);
    const int error = errno;
    const bool failed = ferror(file) != 0;
    const bool longer = fgetc(file) != EOF;
    (void)fclose(file);
    if (!failed && !longer && count == sizeof image->bytes) {
        return true;
    }
    if (failed) {
        (void)fprintf(stderr, "diarc_ecu: --params %s: %s; expected a parameter image of %zu bytes\n", path,
                      strerror(error), sizeof image->bytes);
    } else {
        (void)fprintf(stderr,
                      "diarc_ecu: --params %s: the file has %s%zu bytes, expected a parameter image of %zu\n",
                      path, longer ? "more than " : "", count, sizeof image->bytes);
    }
    return false;
}

/* NULL: no fault, nothing to say. */
static const char *store_fault_text(enum store_status status)
{
    switch (status) {
    case STORE_OLDER:
        return "one of its two sets is damaged and may have been the newer one, the other is in use";
    case STORE_DAMAGED:
        return "what was saved is damaged, the default is in use";
    case STORE_FOREIGN:
        return "what was saved does not suit this firmware, the default is in use";
    case STORE_FAILED:
        return "cannot be read, the default is in use";
    case STORE_OK:
    case STORE_EMPTY:
        break;
    }
    return NULL;
}

/* The ECU with its parameters; false after one line on stderr. */
static bool start_ecu(const struct options *options)
{
    if (options->params_path != NULL && !read_image(options->params_path, &the_image)) {
        return false;
    }
    const struct parameter_image *const image = options->params_path != NULL ? &the_image : NULL;
    if (options->store_path != NULL && !store_file_open(&the_store, options->store_path)) {
        (void)fprintf(stderr, "diarc_ecu: %s\n", the_store.message);
        return false;
    }
    const struct store_port *const store = options->store_path != NULL ? &the_store.port : NULL;
    uint16_t entry = 0;
    const enum ecu_status status =
        ecu_init_stored(&the_ecu, store, &stored_image, image, options->period_us, &entry);
    if (status != ECU_OK) {
        const bool names_parameter = status == ECU_PARAMETER_RANGE || status == ECU_PARAMETER_RELATION;
        (void)fprintf(stderr, "diarc_ecu: %s%s%s%s%s\n", image != NULL ? options->params_path : "",
                      image != NULL ? ": " : "", ecu_status_text(status), names_parameter ? ": " : "",
                      names_parameter ? parameter_name(entry) : "");
        return false;
    }
    const char *const fault = store_fault_text(the_ecu.stored);
    if (fault != NULL) {
        (void)fprintf(
            stderr,
            "diarc_ecu: --store %s: %s; the ECU is in FAULT until RESET_FAULT confirms that, and saving "
            "makes the store good again\n",
            options->store_path, fault);
    }
    return true;
}

static struct bus *open_bus(const struct options *options)
{
    struct bus *const bus = options->is_tcp ? &socketcand_bus.bus : &socketcan_bus.bus;
    const bool open = options->is_tcp
                          ? socketcand_open(&socketcand_bus, options->host, options->port, SOCKETCAND_CHANNEL)
                          : socketcan_open(&socketcan_bus, options->bus);
    if (!open) {
        (void)fprintf(stderr, "diarc_ecu: %s\n", bus->message);
        return NULL;
    }
    return bus;
}

/* The strict pace needs it and says what is missing; at realtime pace it is welcome where it is permitted. */
static void request_realtime(enum pace pace, const char *program)
{
    bool has_fifo;
    bool has_locked_memory;
    if (pace == PACE_LOCKSTEP) {
        return; /* at full speed, beside others */
    }
    realtime_request(&has_fifo, &has_locked_memory);
    if (pace == PACE_STRICT && (!has_fifo || !has_locked_memory)) {
        (void)fprintf(stderr,
                      "diarc_ecu: no permission for %s%s%s, so ticks may be late; permit with "
                      "sudo setcap cap_sys_nice,cap_ipc_lock=ep %s or raise ulimit -r and -l\n",
                      has_fifo ? "" : "SCHED_FIFO", !has_fifo && !has_locked_memory ? " and " : "",
                      has_locked_memory ? "" : "locked memory", program);
    }
}

/* One line; empty buckets at the end are left out. */
static void print_histogram(const char *what, const struct time_histogram *histogram)
{
    int last = TIME_BUCKETS - 1;
    while (last > 0 && histogram->count[last] == 0) {
        last--;
    }
    (void)printf("diarc_ecu: %s, us:", what);
    for (int i = 0; i <= last; i++) {
        const bool is_open = i == TIME_BUCKETS - 1;
        (void)printf("  %s%lu %lu", is_open ? ">=" : "<", is_open ? 1ul << (i - 1) : 1ul << i,
                     (unsigned long)histogram->count[i]);
    }
    (void)putchar('\n');
}

static void print_stats(const struct loop_stats *loop, const struct bus_stats *bus)
{
    (void)printf("diarc_ecu: %llu ticks, %llu late, %llu stalled, %llu frames not sent, %llu receive errors, "
                 "%llu frames lost in the socket buffer\n",
                 (unsigned long long)loop->ticks, (unsigned long long)loop->late_ticks,
                 (unsigned long long)loop->stalled_ticks, (unsigned long long)bus->send_drops,
                 (unsigned long long)bus->receive_errors, (unsigned long long)bus->receive_drops);
    print_histogram("ticks by start after the timer", &loop->start_times);
    print_histogram("ticks since the last restart by time from last sensor frame to valve frame",
                    &the_ecu.counters.tick_times);
}

static int run(const struct options *options, const char *program)
{
    if (!start_ecu(options)) {
        return EXIT_WRONG_USE;
    }
    struct bus *const bus = open_bus(options);
    if (bus == NULL) {
        return EXIT_WRONG_USE;
    }
    bus->port.store = options->store_path != NULL ? &the_store.port : NULL;
    bus->port.fallback = options->params_path != NULL ? &the_image : NULL;
    request_realtime(options->pace, program);
    if (!options->quiet) {
        (void)printf("diarc_ecu " DIARC_VERSION " on %s, %s pace, %lu us\n", options->bus,
                     pace_name(options->pace), (unsigned long)options->period_us);
    }

    struct loop_stats stats;
    int exit_status = 0;
    const enum loop_end end = loop_run(options->pace, options->period_us, &the_ecu, bus, &stats);
    if (end == LOOP_FAILED) {
        (void)fprintf(stderr, "diarc_ecu: cannot make a timer: %s\n", strerror(errno));
        exit_status = EXIT_RUN_FAILED;
    }
    if (end == LOOP_BUS_DOWN) {
        (void)fprintf(stderr, "diarc_ecu: %s\n", bus->message);
        exit_status = bus->state == BUS_REFUSED ? EXIT_WRONG_USE : EXIT_RUN_FAILED;
    }
    const bool was_up = bus->state == BUS_UP;
    const bool delivered = bus->close(bus->port.context);
    if (end == LOOP_STOPPED && !(delivered && stats.shutdown_sent)) {
        (void)fputs(
            "diarc_ecu: the last valve frame (zero, disabled) could not be sent; the valves close at the "
            "timeout of their node\n",
            stderr);
        exit_status = was_up ? EXIT_RUN_FAILED : 0; /* without a bus there was nothing left to do */
    }
    if (options->store_path != NULL) {
        store_file_close(&the_store);
    }
    if (!options->quiet) {
        print_stats(&stats, &bus->stats);
    }
    return exit_status;
}

int main(int argc, char *argv[])
{
    /* A reader of our output that goes away must not stop the ECU with its valves open. */
    (void)signal(SIGPIPE, SIG_IGN);
    (void)setvbuf(stdout, NULL, _IOLBF, 0);
    struct options options;
    switch (options_parse(argc, argv, &options)) {
    case OPTIONS_HELP:
        options_print_help();
        return 0;
    case OPTIONS_VERSION:
        (void)puts("diarc_ecu " DIARC_VERSION);
        return 0;
    case OPTIONS_ERROR:
        return EXIT_WRONG_USE;
    case OPTIONS_RUN:
        break;
    }
    return run(&options, argv[0]);
}
