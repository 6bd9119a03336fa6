/* Fuzzing of the SDO server: requests of a client that makes mistakes, in all modes, with a memory that fails. What
 * must hold: each request is answered, by its own kind of answer or an abort; the set in force is always a whole and
 * sound one, and the machine is what follows from it. */
#include <string.h>

#include "bench.h"
#include "ecu/store.h"
#include "tests/unit/frames.h"
#include "tests/unit/parameter_images.h"

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t length);

enum {
    REQUESTS_MAX = 400,
    SDO_REQUEST = 0x601,
    FIRST_PARAMETER = 0x2100,
    IMAGE_OBJECT = 0x2000,
    ABORT = 0x80,
    REQUEST_RUN = 2,
    NMT_START = 1,
    REST_TICKS = 1100
};

enum happening {
    RAW_REQUEST,
    UPLOAD,
    DOWNLOAD,
    CHANGE_PARAMETER,
    LOAD_IMAGE,
    SEGMENT,
    READ_ALL,
    TICKS,
    REQUEST,
    NETWORK,
    SEND_FAILURE,
    MEMORY_FAILURE,
    OTHER_LENGTH,
    REST,
    HAPPENINGS
};

static const uint16_t KNOWN_OBJECTS[] = {
    0x1000, 0x1001, 0x1003, 0x1008, 0x1009, 0x100A, 0x1010, 0x1011, 0x1016, 0x1017, 0x1018, 0x1019,
    0x1200, 0x1400, 0x1600, 0x1800, 0x1A00, 0x2000, 0x2001, 0x2002, 0x2003, 0x2004, 0x2007, 0x200A,
    0x2010, 0x2011, 0x2020, 0x202D, 0x2040, 0x2100, 0x2110, 0x3000, 0x3001, 0x6040, 0x6041};

static struct bench bench;
static unsigned requests_left;

/* ---- the memory ---- */

static struct {
    uint8_t bytes[STORE_SLOTS][STORE_SLOT_BYTES];
    unsigned calls_good; /* how many are left */
} memory;

static bool memory_works(void)
{
    if (memory.calls_good > 0u) {
        memory.calls_good--;
    }
    return memory.calls_good > 0u;
}

static bool memory_read(void *context, uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t length)
{
    (void)context;
    must(slot < STORE_SLOTS && offset + length <= STORE_SLOT_BYTES, "the store reads beyond its slot");
    memcpy(bytes, &memory.bytes[slot][offset], length);
    return memory_works();
}

static bool memory_erase(void *context, uint8_t slot)
{
    (void)context;
    must(slot < STORE_SLOTS, "the store erases beyond its slots");
    memset(memory.bytes[slot], 0xFF, memory.calls_good > 0u ? STORE_SLOT_BYTES : STORE_SLOT_BYTES / 2u);
    return memory_works();
}

static bool memory_program(void *context, uint8_t slot, uint32_t offset, const uint8_t *bytes,
                           uint32_t length)
{
    (void)context;
    must(slot < STORE_SLOTS && offset + length <= STORE_SLOT_BYTES, "the store programs beyond its slot");
    memcpy(&memory.bytes[slot][offset], bytes, memory.calls_good > 0u ? length : length / 2u);
    return memory_works();
}

static const struct store_port STORE = {
    .read = memory_read, .erase = memory_erase, .program = memory_program};

/* ---- what must hold ---- */

static void watch_set(void)
{
    static struct parameter_image checked; /* the last one looked at, and what follows from it */
    static struct machine machine;
    if (memcmp(&checked, &bench.ecu.image, sizeof checked) != 0) {
        struct bases bases;
        uint16_t entry = 0;
        checked = bench.ecu.image;
        must(parameters_load(&machine, &bases, &checked, &entry) == ECU_OK, "the set in force is not sound");
    }
    if (!parameter_set_coming(&bench.ecu)) {
        must(memcmp(&machine, &bench.ecu.machine, sizeof machine) == 0, "the machine is not that of its set");
    }
}

static bool is_initiate(const uint8_t *request)
{
    return (request[0] >> 5) == 1u || (request[0] >> 5) == 2u;
}

/* The answer is one to this request: its kind, and the object it names. */
static void watch_answer(const uint8_t *request, const struct can_frame_11bit *answer)
{
    static const uint8_t expected[8] = {1, 3, 2, 0, 4, 4, 4, 4}; /* by the request's command */
    const uint8_t command = answer->data[0] >> 5;
    must(answer->length == 8u, "an SDO answer has not 8 bytes");
    must(answer->data[0] == ABORT || command == expected[request[0] >> 5],
         "another answer than was asked for");
    if (answer->data[0] == ABORT) {
        const uint8_t kind = answer->data[7];
        must(kind == 0x05u || kind == 0x06u || kind == 0x08u, "an abort code that there is none of");
    }
    if (is_initiate(request)) {
        must(memcmp(&answer->data[1], &request[1], 3) == 0, "the answer names another object");
    }
}

static void tick(void)
{
    bench_tick(&bench);
    watch_set();
}

/* Ticks without a request: no answer may come but the abort of a transfer that was given up. */
static void quiet_ticks(unsigned count)
{
    for (unsigned k = 0; k < count; k++) {
        tick();
        must(bench.answer_count == 0u || (bench.answer_count == 1u && bench.answers[0].data[0] == ABORT),
             "an answer that nobody asked for");
    }
}

/* One request and its answer; false: none is due, or an abort. */
static bool ask(const uint8_t request[8], struct can_frame_11bit *answer)
{
    if (requests_left == 0u) {
        return false;
    }
    requests_left--;
    bench_queue(&bench, sdo_frame(request));
    const bool is_due = (request[0] & 0xE0u) != ABORT && bench.ecu.nmt != NMT_STOPPED &&
                        !bench.ecu.restart_requested && bench.sends_refused == 0u;
    tick();
    if (!is_due) { /* a late answer to it may come as soon as frames pass again */
        while (bench.sends_refused > 0u) {
            tick();
        }
        tick();
        return false;
    }
    must(bench.answer_count > 0u, "a request is not answered");
    must(bench.answer_count == 1u, "a request is answered twice");
    *answer = bench.answers[0];
    watch_answer(request, answer);
    return answer->data[0] != ABORT;
}

/* ---- the client ---- */

static uint16_t object_of(struct input *input)
{
    const uint8_t choice = input_u8(input);
    if (choice < 128u) {
        return KNOWN_OBJECTS[choice % (sizeof KNOWN_OBJECTS / sizeof KNOWN_OBJECTS[0])];
    }
    return choice < 240u ? (uint16_t)(FIRST_PARAMETER + input_u8(input)) : input_u16(input);
}

static void initiate(uint8_t command, uint16_t index, uint8_t sub, uint32_t data,
                     struct can_frame_11bit *answer)
{
    uint8_t request[8];
    sdo_initiate(request, command, index, sub, data);
    (void)ask(request, answer);
}

static void change_parameter(struct input *input)
{
    struct can_frame_11bit answer;
    const uint16_t index = (uint16_t)(FIRST_PARAMETER + input_u8(input) % PARAMETER_COUNT);
    initiate(0x23, index, 0, (uint32_t)input_u16(input) << 16, &answer);
}

/* An image like the one in force, with some numbers and perhaps bases changed, in segments; perhaps broken off. */
static void load_image(struct input *input)
{
    struct parameter_image image = bench.ecu.image;
    const uint8_t choice = input_u8(input);
    input_numbers(input, choice % 4u, &image);
    if ((choice & 0x10u) != 0u) {
        image.bytes[8u + input_u8(input) % 3u] = input_u8(input);
    }
    image_seal(&image);
    if ((choice & 0x20u) != 0u) {
        image.bytes[input_u16(input) % PARAMETER_IMAGE_BYTES] ^= 0x04u;
    }
    uint32_t end = PARAMETER_IMAGE_BYTES;
    if ((choice & 0x40u) != 0u) {
        end = input_u16(input) % (PARAMETER_IMAGE_BYTES + 16u);
    }
    struct can_frame_11bit answer = {.data = {ABORT}};
    initiate((choice & 0x80u) != 0u ? 0x20 : 0x21, IMAGE_OBJECT, 0, PARAMETER_IMAGE_BYTES, &answer);
    bool goes_on = answer.data[0] != ABORT;
    for (uint32_t done = 0; goes_on && done < end; done += 7u) {
        uint8_t request[8] = {(uint8_t)((done / 7u % 2u) << 4)};
        const uint32_t left = PARAMETER_IMAGE_BYTES > done ? PARAMETER_IMAGE_BYTES - done : 0u;
        const uint32_t length = left < 7u ? left : 7u;
        memcpy(&request[1], &image.bytes[done < PARAMETER_IMAGE_BYTES ? done : 0u], length);
        if (left <= 7u && end == PARAMETER_IMAGE_BYTES) {
            request[0] = (uint8_t)(request[0] | ((7u - length) << 1) | 1u);
        }
        goes_on = ask(request, &answer);
    }
}

static void read_all(struct input *input)
{
    struct can_frame_11bit answer = {.data = {ABORT}};
    initiate(0x40, object_of(input), input_u8(input) % 4u, 0, &answer);
    bool goes_on = answer.data[0] == 0x41u;
    for (uint8_t n = 0; goes_on && n < 100u; n++) {
        const uint8_t request[8] = {(uint8_t)(0x60u | (n % 2u) << 4)};
        goes_on = ask(request, &answer) && (answer.data[0] & 1u) == 0u;
    }
}

static void raw_request(struct input *input, uint8_t first)
{
    struct can_frame_11bit answer;
    uint8_t request[8] = {first};
    for (uint8_t k = 1; k < 8u; k++) {
        request[k] = input_u8(input);
    }
    (void)ask(request, &answer);
}

static void happen(struct input *input)
{
    const uint8_t byte = input_u8(input);
    struct can_frame_11bit answer;
    switch ((enum happening)(byte % HAPPENINGS)) {
    case RAW_REQUEST:
        raw_request(input, input_u8(input));
        break;
    case UPLOAD:
        initiate(0x40, object_of(input), input_u8(input) % 4u, 0, &answer);
        break;
    case DOWNLOAD: {
        const uint16_t index = object_of(input);
        const uint8_t sub = input_u8(input) % 4u;
        const uint32_t save = 0x65766173u, load = 0x64616F6Cu;
        const uint8_t choice = byte / HAPPENINGS;
        const uint32_t data = choice == 0u ? save : choice == 1u ? load : input_u32(input);
        initiate((uint8_t)(0x23u | (choice % 4u) << 2), index, sub, data, &answer);
        break;
    }
    case CHANGE_PARAMETER:
        change_parameter(input);
        break;
    case LOAD_IMAGE:
        load_image(input);
        break;
    case SEGMENT:
        raw_request(input, (uint8_t)((byte & 0x10u) | ((byte & 0x20u) != 0u ? 0x60u : (byte >> 5) & 0x0Fu)));
        break;
    case READ_ALL:
        read_all(input);
        break;
    case REQUEST:
        bench_any_request(&bench, input);
        tick();
        break;
    case NETWORK:
        bench_any_nmt(&bench, byte / HAPPENINGS, 1);
        quiet_ticks(1);
        break;
    case SEND_FAILURE:
        bench.sends_refused = input_u8(input) % 32u;
        bench.refusal = PORT_BUSY;
        break;
    case MEMORY_FAILURE:
        memory.calls_good = (byte & 0x10u) != 0u ? UINT16_MAX : input_u8(input);
        break;
    case OTHER_LENGTH: {
        struct can_frame_11bit frame = {.id = SDO_REQUEST, .length = input_u8(input) % 8u};
        for (uint8_t k = 0; k < frame.length; k++) {
            frame.data[k] = input_u8(input);
        }
        bench_queue(&bench, frame);
        quiet_ticks(1);
        break;
    }
    case REST:
        if (requests_left > REST_TICKS / 4u) { /* takes time: at most once */
            requests_left -= REST_TICKS / 4u;
            quiet_ticks(REST_TICKS);
        }
        break;
    case TICKS:
    case HAPPENINGS:
    default:
        quiet_ticks(1u + byte / HAPPENINGS);
        break;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t length)
{
    struct input input = {.bytes = bytes, .length = length};
    const uint8_t start = input_u8(&input);
    must(bench_start(&bench, NULL, 1000), "the built-in machine is refused");
    memset(&memory, 0xFF, sizeof memory);
    memory.calls_good = UINT16_MAX;
    bench.port.store = (start & 0x10u) != 0u ? NULL : &STORE;
    if (start % 4u >= 1u) {
        bench_nmt(&bench, NMT_START, 1);
        tick();
    }
    if (start % 4u == 3u) {
        bench_motion(&bench, REQUEST_RUN, 0, CONTROLLER_DIARC, 0, 1);
        tick();
    }
    requests_left = REQUESTS_MAX;
    while (!input_over(&input) && requests_left > 0u) {
        happen(&input);
    }
    quiet_ticks(3);
    return 0;
}
