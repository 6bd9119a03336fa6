/* Objects 6040h and 6041h: the bits of CiA 408 that fit this ECU. */
#ifndef ECU_CONTROL_WORD_H
#define ECU_CONTROL_WORD_H

#include <stdint.h>

#define CONTROL_WORD_D 1u /* not disabled */
#define CONTROL_WORD_H 2u /* hold */
#define CONTROL_WORD_M 4u /* active */
#define CONTROL_WORD_R 8u /* reset the fault */
#define STATUS_WORD_READY 8u

enum control_request {
    CONTROL_STANDBY, /* 0000, 0001 */
    CONTROL_HOLD,    /* 0011 */
    CONTROL_RUN,     /* 0111 */
    CONTROL_RESET,   /* R, whatever the others are */
    CONTROL_UNKNOWN  /* a bit without those below it, or one that is not used */
};

enum control_request control_word_request(uint16_t word);

#endif
