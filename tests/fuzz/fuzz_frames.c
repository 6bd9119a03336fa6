/* Fuzzing of frames and ticks: the input is a start, then a sequence of what may happen on a bus. */
#include <string.h>

#include "bench.h"
#include "tests/unit/parameter_images.h"

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t length);

enum { TICKS_MAX = 600, LAST_TICKS = 12, REQUEST_RUN = 2, REQUEST_MOVE = 3, NMT_START = 1 };

/* What may happen, one each. */
enum happening {
    TICKS,
    MANY_TICKS,
    SENSOR_VALUE,
    SENSOR_STEP,
    SENSOR_TROUBLE,
    REQUEST,
    MOVE,
    NETWORK,
    FRAME,
    PROTECTED_FRAME,
    TIME_JUMP,
    SEND_FAILURE,
    FLOOD,
    PORT_CALL,
    PLANT,
    NO_TROUBLE,
    HAPPENINGS
};

static const uint32_t PERIODS_US[] = {1000, 1000, 1000, 250, 500, 2000, 5000, 20000};
static const uint16_t KNOWN_IDS[] = {0x000, 0x080, 0x081, 0x181, 0x182, 0x201, 0x202,
                                     0x282, 0x382, 0x481, 0x601, 0x701, 0x702, 0x7FF};

static struct bench bench;

/* The built-in machine with up to three parameters changed; most such machines are refused, which is right. */
static bool power_on(struct input *input, uint8_t choices)
{
    struct parameter_image image = default_parameter_image;
    input_numbers(input, (choices >> 3) % 4u, &image);
    image_seal(&image);
    return bench_start(&bench, &image, PERIODS_US[choices % 8u]);
}

/* To where most of what can go wrong begins, which random frames seldom reach. */
static void get_going(uint8_t start)
{
    if (start % 8u == 0u) {
        return;
    }
    bench_nmt(&bench, NMT_START, 1);
    bench_tick(&bench);
    if (start % 8u == 1u) {
        return;
    }
    bench_motion(&bench, (uint8_t)(start % 8u == 7u ? 7 : REQUEST_RUN), 0, (uint8_t)(start % 3u), 0, 1);
    bench_tick(&bench);
    if (start % 8u >= 4u) {
        bench_motion(&bench, REQUEST_MOVE, (uint8_t)(start & 1u), 0, 900000, 300);
        bench_tick(&bench);
    }
}

static struct can_frame_11bit frame_of(struct input *input)
{
    const uint8_t choice = input_u8(input);
    const size_t known = sizeof KNOWN_IDS / sizeof KNOWN_IDS[0];
    struct can_frame_11bit frame = {.id = choice < 224u ? KNOWN_IDS[choice % known]
                                                        : input_u16(input) & 0x7FFu};
    frame.length = (uint8_t)(choice % 16u == 15u ? input_u8(input) % 9u : 8u);
    if (frame.id == 0u) {
        frame.length = 2;
    }
    for (uint8_t k = 0; k < frame.length; k++) {
        frame.data[k] = input_u8(input);
    }
    return frame;
}

static void sensor_value(struct input *input)
{
    struct sensors *const s = &bench.sensors;
    const uint8_t choice = input_u8(input);
    const uint16_t value = input_u16(input);
    const uint8_t i = choice & 1u;
    switch ((choice >> 1) % 4u) {
    case 0:
        s->angle[i] = (int32_t)(int16_t)value * 256;
        break;
    case 1:
        s->pressure[i][BORE] = value;
        break;
    case 2:
        s->pressure[i][ANNULUS] = value;
        break;
    default:
        s->spool[i] = (int16_t)value;
        break;
    }
}

/* Small, so that it may pass for a motion. */
static void sensor_step(struct input *input)
{
    struct sensors *const s = &bench.sensors;
    const uint8_t choice = input_u8(input);
    const int32_t step = (int8_t)input_u8(input) * (1 << (choice >> 4));
    const uint8_t i = choice & 1u;
    if ((choice & 2u) == 0u) {
        s->angle[i] += step;
        s->angle[i] = s->angle[i] > 8388607 ? 8388607 : s->angle[i] < -8388607 ? -8388607 : s->angle[i];
    } else {
        uint16_t *const pressure = &s->pressure[i][(choice >> 2) & 1u];
        *pressure = (uint16_t)(*pressure + step / 16);
    }
}

static void sensor_trouble(struct input *input)
{
    struct sensors *const s = &bench.sensors;
    const uint8_t choice = input_u8(input);
    const uint8_t which = choice % SENSOR_FRAMES;
    s->silent[which] = (choice & 0x04u) != 0u;
    s->bad_crc[which] = (choice & 0x08u) != 0u;
    s->counter_offset[which] = (choice & 0x10u) != 0u ? 14 : 0;
    s->status[which] = (choice & 0x20u) != 0u ? input_u8(input) % 16u : 0u;
}

static void no_trouble(void)
{
    for (uint8_t k = 0; k < SENSOR_FRAMES; k++) {
        bench.sensors.silent[k] = bench.sensors.bad_crc[k] = false;
        bench.sensors.counter_offset[k] = bench.sensors.status[k] = 0;
    }
    bench.sends_refused = 0;
}

static void ticks(unsigned count, unsigned *left)
{
    for (unsigned k = 0; k<count && * left> 0u; k++, (*left)--) {
        bench_tick(&bench);
    }
}

static void happen(struct input *input, unsigned *ticks_left)
{
    const uint8_t byte = input_u8(input);
    struct can_frame_11bit frame;
    switch ((enum happening)(byte % HAPPENINGS)) {
    case MANY_TICKS:
        ticks(16u * (1u + byte / HAPPENINGS), ticks_left);
        break;
    case SENSOR_VALUE:
        sensor_value(input);
        break;
    case SENSOR_STEP:
        sensor_step(input);
        break;
    case SENSOR_TROUBLE:
        sensor_trouble(input);
        break;
    case REQUEST:
        bench_any_request(&bench, input);
        break;
    case MOVE: {
        const int32_t target = (int16_t)input_u16(input) * 128;
        bench_motion(&bench, REQUEST_MOVE, byte / HAPPENINGS & 1u, 0, target, input_u16(input));
        break;
    }
    case NETWORK:
        bench_any_nmt(&bench, byte / HAPPENINGS, input_u8(input) % 4u);
        break;
    case FRAME:
        bench_queue(&bench, frame_of(input));
        break;
    case PROTECTED_FRAME:
        frame = frame_of(input);
        e2e_protect((uint16_t)frame.id, (uint8_t)((frame.data[1] & 0x0Fu) % E2E_COUNTER_STATES), frame.data);
        bench_queue(&bench, frame);
        break;
    case TIME_JUMP:
        bench.now_us += input_u32(input);
        break;
    case SEND_FAILURE:
        bench.sends_refused = input_u8(input);
        bench.refusal = (byte & 0x10u) != 0u ? PORT_DOWN : PORT_BUSY;
        break;
    case FLOOD:
        frame = frame_of(input);
        for (unsigned k = 0; k < 8u * (1u + byte / HAPPENINGS); k++) {
            bench_queue(&bench, frame);
        }
        break;
    case PORT_CALL:
        if ((byte & 0x10u) != 0u) {
            ecu_request_safe_stop(&bench.ecu);
        } else if ((byte & 0x20u) != 0u) {
            ecu_note_late_start(&bench.ecu, input_u8(input));
        } else {
            ecu_shutdown(&bench.ecu, &bench.port);
        }
        break;
    case PLANT:
        bench.sensors.plant_follows = (byte & 0x10u) != 0u;
        bench.sensors.noise = byte / 32u;
        break;
    case NO_TROUBLE:
        no_trouble();
        break;
    case TICKS:
    case HAPPENINGS:
    default:
        ticks(1u + byte / HAPPENINGS, ticks_left);
        break;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t length)
{
    struct input input = {.bytes = bytes, .length = length};
    const uint8_t choices = input_u8(&input);
    const uint8_t start = input_u8(&input);
    if (!power_on(&input, choices)) {
        return 0;
    }
    get_going(start);
    unsigned ticks_left = TICKS_MAX;
    while (!input_over(&input) && ticks_left > 0u) {
        happen(&input, &ticks_left);
    }
    for (unsigned k = 0; k < LAST_TICKS; k++) {
        bench_tick(&bench);
    }
    return 0;
}
