#include "ports/cortex_m/measure.h"

#if defined(DIARC_COUNT_INSTRUCTIONS)

#include <stddef.h>

#include "ecu/ecu.h"
#include "ports/cortex_m/clock.h"
#include "ports/cortex_m/registers.h"
#include "ports/cortex_m/uart.h"

#define STACK_PATTERN 0xA5A5A5A5u
#define LAST_LINE 0xFFu

extern uint32_t image_stack_begin[], image_stack_end[];

struct figures {
    uint32_t tick; /* this tick's cycles */
    uint32_t least, most;
    uint64_t sum;
};

static struct figures figures[STAGES];
static uint32_t ticks;
static enum stage current = STAGE_WAIT;
static uint32_t since;
static uint32_t overhead; /* what measuring itself takes from one switch to the next */

void measure_start(void)
{
    const uint32_t *const used = stack_pointer();
    for (uint32_t *word = image_stack_begin; word < used; word++) {
        *word = STACK_PATTERN;
    }
    (void)measure_switch(STAGE_WAIT);
    (void)measure_switch(STAGE_WAIT);
    figures[STAGE_WAIT].tick = 0;
    (void)measure_switch(STAGE_WAIT);
    overhead = figures[STAGE_WAIT].tick;
    figures[STAGE_WAIT].tick = 0;
}

enum stage measure_switch(enum stage stage)
{
    interrupts_disable();
    const uint32_t now = clock_cycles();
    const enum stage before = current;
    figures[before].tick += now - since - overhead;
    current = stage;
    since = now;
    interrupts_enable();
    return before;
}

void measure_end_tick(void)
{
    figures[STAGE_TICK].tick = figures[STAGE_FRAMES].tick + figures[STAGE_ESTIMATE].tick +
                               figures[STAGE_CONTROL].tick + figures[STAGE_SEND].tick;
    for (uint8_t k = 0; k < STAGES; k++) {
        struct figures *const f = &figures[k];
        f->least = ticks == 0u || f->tick < f->least ? f->tick : f->least;
        f->most = f->tick > f->most ? f->tick : f->most;
        f->sum += f->tick;
        f->tick = 0;
    }
    ticks++;
}

/* controller.c and ecu.c call these instead in an image that counts (CMakeLists.txt). */
void measured_estimator_step(struct estimator *estimator, const struct estimator_parameters *parameters,
                             const struct estimator_constants *constants, const struct arm *arm,
                             const struct estimator_sample *sample);
void measured_controller_step(struct controller *controller, const struct machine *machine,
                              const struct controller_constants *constants,
                              const struct measurement *measured);

void measured_estimator_step(struct estimator *estimator, const struct estimator_parameters *parameters,
                             const struct estimator_constants *constants, const struct arm *arm,
                             const struct estimator_sample *sample)
{
    const enum stage before = measure_switch(STAGE_ESTIMATE);
    estimator_step(estimator, parameters, constants, arm, sample);
    (void)measure_switch(before);
}

void measured_controller_step(struct controller *controller, const struct machine *machine,
                              const struct controller_constants *constants,
                              const struct measurement *measured)
{
    const enum stage before = measure_switch(STAGE_CONTROL);
    controller_step(controller, machine, constants, measured);
    (void)measure_switch(before);
}

static void answer(uint32_t stage, uint32_t a, uint32_t b, uint32_t c)
{
    struct uart_line *const line = uart_free_line();
    if (line == NULL) {
        return;
    }
    const uint32_t numbers[] = {a, b, c};
    line->first = (uint8_t)'M';
    line->last = (uint8_t)'\r';
    line->digits = 2u * UART_DIGIT_BYTES;
    line->packed[0] = (uint8_t)stage;
    for (uint8_t k = 0; k < UART_DIGIT_BYTES - 1u; k++) {
        line->packed[1u + k] = (uint8_t)(numbers[k / 4u] >> (24u - 8u * (k % 4u)));
    }
    uart_send();
}

bool measure_command(uint8_t verb)
{
    if (verb != (uint8_t)'M') {
        return false;
    }
    for (uint8_t k = 0; k < STAGES; k++) {
        const struct figures *const f = &figures[k];
        answer(k, f->least, ticks > 0u ? (uint32_t)(f->sum / ticks) : 0u, f->most);
    }
    const uint32_t *word = image_stack_begin;
    while (word < image_stack_end && *word == STACK_PATTERN) {
        word++;
    }
    answer(LAST_LINE, ticks, (uint32_t)(image_stack_end - word) * 4u, 0);
    return true;
}

#endif
