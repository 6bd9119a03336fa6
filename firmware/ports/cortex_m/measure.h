/* With DIARC_COUNT_INSTRUCTIONS: how many processor cycles each stage of a tick takes, and the stack's
 * depth. Where an instruction takes a fixed time, as in QEMU with -icount, the cycles count instructions.
 * Else nothing of this is in the image. Estimate and control are parts of ecu_tick_end: measure.c has a function that
 * measures in front of each of theirs, which are functions of their own in every image (OWN_FRAME), so that the code that
 * is measured is the code that runs. The SLCAN command M answers for all ticks since the start, of every mode, in
 * hexadecimal:
 *
 *     M STAGE least mean most     a line for each stage: two digits and three times eight, without spaces
 *     MFF ticks stack 0            the ticks counted, the bytes of stack used */
#ifndef PORTS_CORTEX_M_MEASURE_H
#define PORTS_CORTEX_M_MEASURE_H

#include <stdbool.h>
#include <stdint.h>

/* Every cycle counts for one stage. */
enum stage {
    STAGE_WAIT,     /* between ticks and for frames */
    STAGE_UART,     /* interrupts: a byte from and to the UART; a CAN peripheral needs none of it */
    STAGE_RECEIVE,  /* SLCAN text to frames, their checks, requests */
    STAGE_FRAMES,   /* SYNC, samples out of frames, supervision, packing of frames */
    STAGE_ESTIMATE, /* estimator_step */
    STAGE_CONTROL,  /* the rest of controller_step: reference, observer, cylinders, law */
    STAGE_SEND,     /* frames to SLCAN text */
    STAGE_TICK,     /* no stage: frames, estimate, control and send of a tick together */
    STAGES
};

#if defined(DIARC_COUNT_INSTRUCTIONS)
void measure_start(void);
/* What follows counts for `stage`; the stage before. */
enum stage measure_switch(enum stage stage);
/* A tick is over. */
void measure_end_tick(void);
/* Answers M; false when the command is another. */
bool measure_command(uint8_t verb);
#else
static inline void measure_start(void)
{
}
static inline enum stage measure_switch(enum stage stage)
{
    return stage;
}
static inline void measure_end_tick(void)
{
}
static inline bool measure_command(uint8_t verb)
{
    (void)verb;
    return false;
}
#endif

#endif
