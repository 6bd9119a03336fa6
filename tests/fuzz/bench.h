/* What the fuzz harnesses share: an ECU on a port of arrays, a plant that roughly follows the valves, and what must
 * hold whatever comes. A broken invariant is one line on stderr and an abort, which libFuzzer keeps the input of. */
#ifndef BENCH_H
#define BENCH_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "ecu/e2e.h"
#include "ecu/ecu.h"

/* The input, taken from its front; zeros after its end. */
struct input {
    const uint8_t *bytes;
    size_t length, next;
};

bool input_over(const struct input *input);
uint8_t input_u8(struct input *input);
uint16_t input_u16(struct input *input);
uint32_t input_u32(struct input *input);
/* So many of an image's numbers, in the upper halves of their binary32; its CRC is left as it is. */
void input_numbers(struct input *input, uint8_t count, struct parameter_image *image);

enum sensor_frame { ENCODERS, PRESSURES_SWING, PRESSURES_WRIST, SENSOR_FRAMES };

/* What the sensors say and how. */
struct sensors {
    int32_t angle[JOINTS];
    uint16_t pressure[JOINTS][CHAMBERS];
    int16_t spool[JOINTS];
    uint8_t status[SENSOR_FRAMES];
    bool silent[SENSOR_FRAMES];
    uint8_t counter_offset[SENSOR_FRAMES]; /* 0: answers this SYNC */
    bool bad_crc[SENSOR_FRAMES];
    bool plant_follows; /* angles, pressures and spools react to the valve commands */
    uint8_t noise;      /* raw steps */
};

enum { BENCH_WAITING = 512, BENCH_SDO = 64 };

struct bench {
    struct ecu ecu;
    struct ecu_port port;
    struct sensors sensors;
    struct can_frame_11bit waiting[BENCH_WAITING];
    unsigned waiting_count, waiting_next;
    unsigned sends_refused; /* how many of the next ones */
    enum port_status refusal;
    uint32_t now_us;
    uint32_t random;
    uint8_t motion_counter;
    bool reset_asked; /* an NMT reset went to the ECU: INIT may follow from any mode */
    uint8_t mode;     /* as last looked at */
    bool bus_active;  /* what the last valve frame that the bus took says */
    bool send_failed; /* in this tick */
    int16_t spool[JOINTS];
    unsigned valve_frames;                     /* in this tick */
    struct can_frame_11bit answers[BENCH_SDO]; /* SDO, in this tick */
    unsigned answer_count;
};

/* Power on. false: the ECU refuses these parameters or this period. image NULL: the built-in one. */
bool bench_start(struct bench *bench, const struct parameter_image *image, uint32_t period_us);

void bench_queue(struct bench *bench, struct can_frame_11bit frame);
void bench_nmt(struct bench *bench, uint8_t command, uint8_t node);
/* A request of a master, well protected. */
void bench_motion(struct bench *bench, uint8_t request, uint8_t joint, uint8_t controller, int32_t target,
                  uint16_t duration_ms);
/* Of those that fit the frame's bits, without joint and target. */
void bench_any_request(struct bench *bench, struct input *input);
/* The start more often than the others. */
void bench_any_nmt(struct bench *bench, uint8_t choice, uint8_t node);

/* One tick with the sensors' frames, everything checked. */
void bench_tick(struct bench *bench);

/* Give up with a reason, when what must hold does not. */
void must(bool holds, const char *what);

#endif
