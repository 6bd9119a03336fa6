/* The protocol of the SDO server (ecu/sdo_server): what a client that is wrong, gone or in a hurry must not do to it. */
#include "sdo_client.h"

#define IMAGE_SEGMENTS ((PARAMETER_IMAGE_BYTES + 6u) / 7u)

void setUp(void)
{
    power_on();
}

void tearDown(void)
{
}

/* An image that is not the one in force, and fine. */
static struct parameter_image other_image(void)
{
    struct parameter_image image = default_parameter_image;
    image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * entry_named("wrist.q_max_rad"), bits_of(0.9));
    image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * entry_named("control.swing.k1_1_s"), bits_of(11));
    image_seal(&image);
    return image;
}

/* Machine, bases and constants are those of an ECU that was started with the image. */
static void expect_set(const struct parameter_image *image)
{
    static struct ecu fresh;
    uint16_t entry;
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&fresh, image, 1000, &entry));
    TEST_ASSERT_EQUAL_MEMORY(image, &ecu.image, sizeof *image);
    TEST_ASSERT_EQUAL_MEMORY(&fresh.machine, &ecu.machine, sizeof fresh.machine);
    TEST_ASSERT_EQUAL_MEMORY(&fresh.bases, &ecu.bases, sizeof fresh.bases);
    TEST_ASSERT_EQUAL_MEMORY(&fresh.constants, &ecu.constants, sizeof fresh.constants);
    TEST_ASSERT_FALSE(parameter_set_coming(&ecu));
}

static void test_unknown_command_answered_or_ignored(void)
{
    /* GIVEN block transfers and the command that is none WHEN asked THEN each is aborted as unknown */
    static const uint8_t commands[] = {0xA0, 0xA4, 0xC0, 0xC6, 0xE0, 0xFF};
    for (unsigned k = 0; k < COUNT_OF(commands); k++) {
        TEST_ASSERT_EQUAL_HEX32(ABORT_COMMAND, abort_of(ask_for(commands[k], 0x1000, 0, 0), 0x1000, 0));
    }
}

static void test_segment_of_no_transfer_answered(void)
{
    /* GIVEN no transfer, or one in the other direction WHEN a segment comes THEN it is aborted as unknown */
    static const uint8_t up[8] = {0x60};
    static const uint8_t down[8] = {0x00};
    TEST_ASSERT_EQUAL_HEX32(ABORT_COMMAND, u32_of(ask(up) + 4));
    TEST_ASSERT_EQUAL_HEX32(ABORT_COMMAND, u32_of(ask(down) + 4));
    TEST_ASSERT_EQUAL_HEX8(0x41, ask_for(0x40, 0x1008, 0, 0)[0]);
    TEST_ASSERT_EQUAL_HEX32(ABORT_COMMAND, u32_of(ask(down) + 4));
    TEST_ASSERT_EQUAL_HEX32(ABORT_COMMAND, u32_of(ask(up) + 4)); /* and the transfer is over */
    TEST_ASSERT_EQUAL_HEX8(0x60, ask_for(0x21, 0x1017, 0, 2)[0]);
    TEST_ASSERT_EQUAL_HEX32(ABORT_COMMAND, u32_of(ask(up) + 4));
    TEST_ASSERT_EQUAL_HEX32(ABORT_COMMAND, u32_of(ask(down) + 4));
}

static void test_repeated_segment_taken_twice(void)
{
    /* GIVEN a transfer each way WHEN the toggle bit does not change THEN it is aborted, and nothing was written */
    const struct parameter_image image = other_image();
    const uint8_t again[8] = {0x70};
    TEST_ASSERT_EQUAL_HEX8(0x41, ask_for(0x40, 0x1008, 0, 0)[0]);
    TEST_ASSERT_EQUAL_HEX32(ABORT_TOGGLE, abort_of(ask(again), 0x1008, 0)); /* the first is 0 */
    TEST_ASSERT_EQUAL_HEX8(0x41, ask_for(0x40, 0x1008, 0, 0)[0]);
    TEST_ASSERT_EQUAL_HEX8(0x00, ask_for(0x60, 0, 0, 0)[0]);
    TEST_ASSERT_EQUAL_HEX32(ABORT_TOGGLE, abort_of(ask_for(0x60, 0, 0, 0), 0x1008, 0));

    TEST_ASSERT_EQUAL_HEX32(0, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 1));
    const uint8_t first[8] = {0x00, 1, 2, 3, 4, 5, 6, 7};
    TEST_ASSERT_EQUAL_HEX32(ABORT_TOGGLE, abort_of(ask(first), 0x2000, 0));
    expect_set(&default_parameter_image);
}

static void test_download_cut_anywhere_leaves_a_mixture(void)
{
    /* GIVEN an image in segments WHEN it is cut after any of them, by the client, by another request, by silence, by
     * a reset or a stop of the network THEN the set in force is the old one in every bit */
    const struct parameter_image image = other_image();
    static const uint8_t client_abort[8] = {0x80, 0, 0x20, 0, 0, 0, 4, 5};
    for (uint32_t segments = 0; segments < IMAGE_SEGMENTS; segments++) {
        TEST_ASSERT_EQUAL_HEX32(0, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, segments));
        TEST_ASSERT_TRUE(parameter_set_coming(&ecu));
        TEST_ASSERT_EQUAL_MEMORY(&default_parameter_image, &ecu.image, sizeof ecu.image);
        switch (segments % 5u) {
        case 0:
            TEST_ASSERT_NULL(ask(client_abort));
            break;
        case 1:
            TEST_ASSERT_EQUAL_UINT32(0x81, number(0x1014, 0));
            break;
        case 2:
            ticks(SDO_TIMEOUT_TICKS);
            break;
        case 3:
            queue_nmt(129);
            ticks(2);
            break;
        default:
            queue_nmt(2);
            ticks(SDO_TIMEOUT_TICKS + 1);
            queue_nmt(128);
            tick();
            break;
        }
        expect_set(&default_parameter_image);
    }
    TEST_ASSERT_EQUAL_HEX32(0, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, IMAGE_SEGMENTS));
    expect_set(&image);
}

static void test_image_that_is_wrong_taken(void)
{
    /* GIVEN images with one thing wrong WHEN the last segment comes THEN it is aborted with the reason, the offender
     * is told, and the old set is in force */
    const uint16_t q_max = entry_named("wrist.q_max_rad");
    const uint16_t rod = entry_named("swing.rod_m");
    const uint16_t observer = entry_named("control.observer_rad_s");
    struct parameter_image image = other_image();
    image.bytes[100] ^= 1u;
    TEST_ASSERT_EQUAL_HEX32(ABORT_CRC, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    expect_set(&default_parameter_image);

    image = other_image();
    image.bytes[0] = 'd';
    TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    image = other_image();
    image.bytes[5] ^= 1u;
    TEST_ASSERT_EQUAL_HEX32(ABORT_INCOMPATIBLE,
                            write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    image = other_image();
    image.bytes[8] = 100;
    image_seal(&image);
    TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    TEST_ASSERT_EQUAL_UINT32(NO_PARAMETER, number(0x200E, 0));
    expect_set(&default_parameter_image);

    image = other_image();
    image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * q_max, bits_of(4));
    image_seal(&image);
    TEST_ASSERT_EQUAL_HEX32(ABORT_RANGE, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    TEST_ASSERT_EQUAL_UINT32(q_max, number(0x200E, 0));
    image = other_image();
    image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * rod, bits_of(0.45));
    image_seal(&image);
    TEST_ASSERT_EQUAL_HEX32(ABORT_INCOMPATIBLE,
                            write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    TEST_ASSERT_EQUAL_UINT32(rod, number(0x200E, 0));
    expect_set(&default_parameter_image);

    /* fine by itself, but not at this period */
    uint16_t entry;
    TEST_ASSERT_EQUAL_INT(ECU_OK, ecu_init(&ecu, NULL, 2000, &entry));
    image = default_parameter_image;
    image_set_u32(&image, IMAGE_HEADER_BYTES + 4u * observer, bits_of(600));
    image_seal(&image);
    TEST_ASSERT_EQUAL_HEX32(ABORT_INCOMPATIBLE,
                            write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    TEST_ASSERT_EQUAL_MEMORY(&default_parameter_image, &ecu.image, sizeof ecu.image);
    TEST_ASSERT_EQUAL_HEX32(ABORT_INCOMPATIBLE,
                            write_number((uint16_t)(0x2100 + observer), 0, bits_of(600), 4));
    TEST_ASSERT_EQUAL_MEMORY(&default_parameter_image, &ecu.image, sizeof ecu.image);
}

static void test_valves_driven_while_there_is_no_machine(void)
{
    /* GIVEN a download under way WHEN RUN, TARE or the control word ask for it THEN they are refused, and granted
     * when it is over; the estimate stays what it was */
    const struct parameter_image image = other_image();
    to_standby();
    const struct ud_factors before = ecu.controller.estimator.covariance_m;
    TEST_ASSERT_EQUAL_HEX32(0, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 40));
    queue_request(2, CONTROLLER_DIARC);
    ticks(3);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    queue_request(5, 0);
    ticks(3);
    TEST_ASSERT_EQUAL_INT(MODE_STANDBY, ecu.mode);
    TEST_ASSERT_EQUAL_UINT16(2, ecu.counters.refused);
    TEST_ASSERT_TRUE(parameter_set_coming(&ecu));
    TEST_ASSERT_EQUAL_HEX32(0x81, number(0x1014, 0)); /* another request: it is over */
    TEST_ASSERT_FALSE(parameter_set_coming(&ecu));
    TEST_ASSERT_EQUAL_MEMORY(&before, &ecu.controller.estimator.covariance_m, sizeof before);
    queue_request(2, CONTROLLER_DIARC);
    tick();
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

static void test_download_begun_while_the_valves_are_driven(void)
{
    /* GIVEN RUN WHEN a download of an image begins THEN it is aborted for the state, and the machine stays */
    const struct parameter_image image = other_image();
    to_run();
    TEST_ASSERT_EQUAL_HEX32(ABORT_STATE, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    expect_set(&default_parameter_image);
    TEST_ASSERT_EQUAL_INT(MODE_RUN, ecu.mode);
}

static void test_length_of_a_write_not_looked_at(void)
{
    /* GIVEN writes of too few and too many bytes, told or found out WHEN made THEN they are aborted for their length,
     * and nothing was written */
    TEST_ASSERT_EQUAL_HEX32(ABORT_LENGTH, write_number(0x1017, 0, 5, 1));
    TEST_ASSERT_EQUAL_HEX32(ABORT_LENGTH, write_number(0x1017, 0, 5, 3));
    TEST_ASSERT_EQUAL_HEX32(ABORT_LENGTH, write_number(0x1017, 0, 5, 4));
    TEST_ASSERT_EQUAL_HEX32(ABORT_LENGTH, write_number(0x2100, 0, 5, 2));
    TEST_ASSERT_EQUAL_HEX32(ABORT_LENGTH, write_number(0x2000, 0, 5, 4));
    const uint8_t bytes[PARAMETER_IMAGE_BYTES + 7] = {7};
    TEST_ASSERT_EQUAL_HEX32(ABORT_LENGTH, write_segments(0x1017, 0, bytes, 3, 9));
    TEST_ASSERT_EQUAL_HEX32(ABORT_LENGTH, write_segments(0x2000, 0, bytes, PARAMETER_IMAGE_BYTES - 1u, 99));
    /* the size not told at the beginning */
    static const struct {
        uint16_t index;
        uint8_t segment[8];
    } cases[] = {
        {0x1017, {0x0D, 1}},                   /* one byte of two, the last */
        {0x1017, {0x09, 1, 2, 3}},             /* three of two */
        {0x2000, {0x01, 'D', 'I', 'A', 'R'}},  /* seven of all */
        {0x2105, {0x01, 1, 2, 3, 4, 5, 6, 7}}, /* seven of four */
        {0x2105, {0x07, 1, 2, 3, 4}},          /* four: fine as to length, no number there */
    };
    for (unsigned k = 0; k < COUNT_OF(cases); k++) {
        TEST_ASSERT_EQUAL_HEX8(0x60, ask_for(0x20, cases[k].index, 0, 0)[0]);
        const uint32_t code = abort_of(ask(cases[k].segment), cases[k].index, 0);
        TEST_ASSERT_EQUAL_HEX32(k + 1u < COUNT_OF(cases) ? (uint32_t)ABORT_LENGTH : (uint32_t)ABORT_TOO_LOW,
                                code);
    }
    TEST_ASSERT_EQUAL_UINT32(100, number(0x1017, 0));
    expect_set(&default_parameter_image);
}

static void test_more_segments_than_an_image_written_past_it(void)
{
    /* GIVEN a download of untold size WHEN one segment more comes than an image has THEN it is aborted */
    TEST_ASSERT_EQUAL_HEX8(0x60, ask_for(0x20, 0x2000, 0, 0)[0]);
    uint8_t segment[8] = {0, 1, 2, 3, 4, 5, 6, 7};
    const uint8_t *answer = NULL;
    for (uint32_t k = 0; k < IMAGE_SEGMENTS; k++) {
        answer = ask(segment);
        segment[0] ^= 0x10u;
    }
    TEST_ASSERT_EQUAL_HEX32(ABORT_LENGTH, abort_of(answer, 0x2000, 0)); /* 544 is no multiple of 7 */
    expect_set(&default_parameter_image);
}

static void test_image_longer_than_its_room_written_past_it(void)
{
    /* GIVEN an image but for its last byte WHEN more comes than is left THEN none of it is written, and what follows
     * the image in the ECU keeps its bytes */
    static struct ecu before;
    to_standby();
    const struct parameter_image old = ecu.image;
    parameter_set_begin(&ecu);
    for (uint16_t k = 0; k + 1u < PARAMETER_IMAGE_BYTES; k++) {
        TEST_ASSERT_TRUE(parameter_set_add(&ecu, &old.bytes[k], 1));
    }
    memcpy(&before, &ecu, sizeof ecu);
    const uint8_t two[2] = {0x5A, 0x5A};
    TEST_ASSERT_FALSE(parameter_set_add(&ecu, two, 2));
    TEST_ASSERT_EQUAL_MEMORY(&before, &ecu, sizeof ecu);
}

static void test_image_without_its_end_put_into_use(void)
{
    /* GIVEN an image of which the last byte is missing WHEN taken THEN it is none, the machine is that of the set in
     * force again, and the next image is taken */
    uint16_t entry = 7;
    to_standby();
    const struct parameter_image old = ecu.image;
    const struct machine machine = ecu.machine;
    parameter_set_begin(&ecu);
    for (uint16_t k = 0; k + 1u < PARAMETER_IMAGE_BYTES; k++) {
        TEST_ASSERT_TRUE(parameter_set_add(&ecu, &old.bytes[k], 1));
    }
    TEST_ASSERT_EQUAL_INT(ECU_IMAGE_NOT_ONE, parameter_set_take(&ecu, &entry));
    TEST_ASSERT_EQUAL_UINT16(0, entry);
    TEST_ASSERT_FALSE(parameter_set_coming(&ecu));
    TEST_ASSERT_EQUAL_MEMORY(&old, &ecu.image, sizeof old);
    TEST_ASSERT_EQUAL_MEMORY(&machine, &ecu.machine, sizeof machine);
    TEST_ASSERT_EQUAL_HEX32(0, write_segments(0x2000, 0, old.bytes, PARAMETER_IMAGE_BYTES, UINT32_MAX));
}

static void test_transfer_that_lost_its_object_sends_other_bytes(void)
{
    /* GIVEN a text that is being read WHEN the ECU no longer knows of what THEN abort, instead of bytes of something */
    TEST_ASSERT_EQUAL_HEX8(0x41, ask_for(0x40, 0x1008, 0, 0)[0]);
    ecu.sdo.index = 0x1009 + 0x4000; /* there is none: as after a bit that has flipped */
    const uint8_t *const answer = ask_for(0x60, 0, 0, 0);
    TEST_ASSERT_EQUAL_HEX32(ABORT_NO_OBJECT, abort_of(answer, 0x5009, 0));
    TEST_ASSERT_EQUAL_INT(SDO_IDLE, ecu.sdo.transfer);
}

static void test_number_in_segments_not_understood(void)
{
    /* GIVEN a number that comes in segments, and one expedited of untold size WHEN written THEN both are taken */
    const uint8_t value[2] = {0xFA, 0x00};
    TEST_ASSERT_EQUAL_HEX32(0, write_segments(0x1017, 0, value, 2, 9));
    TEST_ASSERT_EQUAL_UINT32(250, number(0x1017, 0));
    TEST_ASSERT_EQUAL_HEX8(0x60, ask_for(0x22, 0x1017, 0, 0xFFFF0064)[0]);
    TEST_ASSERT_EQUAL_UINT32(100, number(0x1017, 0));
    /* byte by byte, each in a segment of its own */
    TEST_ASSERT_EQUAL_HEX8(0x60, ask_for(0x21, 0x1017, 0, 2)[0]);
    const uint8_t low[8] = {0x0C, 0x01};
    const uint8_t high[8] = {0x1D, 0x02};
    TEST_ASSERT_EQUAL_HEX8(0x20, ask(low)[0]);
    TEST_ASSERT_EQUAL_UINT16(100, ecu.heartbeat_ms);
    TEST_ASSERT_EQUAL_HEX8(0x30, ask(high)[0]);
    TEST_ASSERT_EQUAL_UINT32(0x201, number(0x1017, 0));
}

static void test_transfer_waits_for_ever(void)
{
    /* GIVEN an upload and a download WHEN the client rests THEN after 1 s, not before, the server aborts; each
     * segment starts the time anew */
    for (int download = 0; download < 2; download++) {
        const uint8_t first[8] = {download ? 0x00 : 0x60};
        TEST_ASSERT_EQUAL_HEX8(download ? 0x60 : 0x41, ask_for(download ? 0x20 : 0x40, 0x2000, 0, 0)[0]);
        for (int k = 0; k < SDO_TIMEOUT_TICKS - 2; k++) {
            tick();
            TEST_ASSERT_NULL(sent(SDO_ANSWER_ID));
        }
        TEST_ASSERT_EQUAL_HEX8(download ? 0x20 : 0x00, ask(first)[0]);
        for (int k = 0; k < SDO_TIMEOUT_TICKS - 1; k++) {
            tick();
            TEST_ASSERT_NULL(sent(SDO_ANSWER_ID));
        }
        tick();
        TEST_ASSERT_NOT_NULL(sent(SDO_ANSWER_ID));
        TEST_ASSERT_EQUAL_HEX32(ABORT_TIMEOUT, abort_of(sent(SDO_ANSWER_ID)->data, 0x2000, 0));
        ticks(3);
        TEST_ASSERT_NULL(sent(SDO_ANSWER_ID));
    }
    expect_set(&default_parameter_image);
}

static void test_abort_of_the_client_answered(void)
{
    /* GIVEN a transfer or none WHEN the client aborts THEN nothing is said, and the transfer is over */
    static const uint8_t gone[8] = {0x80, 0x08, 0x10, 0, 0, 0, 4, 5};
    TEST_ASSERT_NULL(ask(gone));
    TEST_ASSERT_EQUAL_HEX8(0x41, ask_for(0x40, 0x1008, 0, 0)[0]);
    TEST_ASSERT_NULL(ask(gone));
    TEST_ASSERT_EQUAL_HEX32(ABORT_COMMAND, u32_of(ask_for(0x60, 0, 0, 0) + 4));
}

static void test_stopped_node_answers(void)
{
    /* GIVEN NMT stop WHEN asked THEN nothing is answered, then or later; in pre-operational it is */
    TEST_ASSERT_EQUAL_UINT32(0x81, number(0x1014, 0));
    queue_nmt(2);
    tick();
    static const uint8_t request[8] = {0x40, 0x14, 0x10};
    TEST_ASSERT_NULL(ask(request));
    queue_nmt(128);
    ticks(3);
    TEST_ASSERT_NULL(sent(SDO_ANSWER_ID));
    TEST_ASSERT_EQUAL_UINT32(0x81, number(0x1014, 0));
}

static void test_frame_of_wrong_length_answered(void)
{
    /* GIVEN a request of 7 bytes WHEN it comes THEN it is no SDO */
    queue((struct can_frame_11bit){.id = SDO_REQUEST_ID, .length = 7, .data = {0x40, 0x14, 0x10}});
    tick();
    TEST_ASSERT_NULL(sent(SDO_ANSWER_ID));
}

static void test_answer_lost_on_a_busy_bus(void)
{
    /* GIVEN a port that takes no frame WHEN an object is asked for THEN the answer goes out when it does, once; a new
     * request takes its place */
    static const uint8_t request[8] = {0x40, 0x14, 0x10};
    wire.full = true;
    TEST_ASSERT_NULL(ask(request));
    ticks(5);
    wire.full = false;
    tick();
    TEST_ASSERT_EQUAL_HEX32(0x81, u32_of(sent(SDO_ANSWER_ID)->data + 4));
    tick();
    TEST_ASSERT_NULL(sent(SDO_ANSWER_ID));
    wire.full = true;
    TEST_ASSERT_NULL(ask(request));
    wire.full = false;
    TEST_ASSERT_EQUAL_HEX32(0x40000080, number(0x1005, 0));
}

static void test_valve_frame_waits_for_sdo(void)
{
    /* GIVEN RUN and a client that asks in every tick WHEN the tick ends THEN the answer goes out after the valve
     * frame, one a tick, and the valves are what they are without a client */
    static struct ecu alone;
    int32_t spools[2][40][2];
    for (int with = 0; with < 2; with++) {
        power_on();
        to_run();
        for (int k = 0; k < 40; k++) {
            if (with) {
                for (int n = 0; n < 3; n++) {
                    queue((struct can_frame_11bit){
                        .id = SDO_REQUEST_ID, .length = 8, .data = {0x40, (uint8_t)(0x20 + k % 14), 0x20}});
                }
            }
            tick();
            unsigned valve = 0;
            unsigned answer = 0;
            for (unsigned n = 0; n < wire.sent_count; n++) {
                valve = wire.sent[n].id == 0x202u ? n : valve;
                answer = wire.sent[n].id == SDO_ANSWER_ID ? n : answer;
            }
            TEST_ASSERT_TRUE(!with || answer > valve);
            spools[with][k][0] = get_signed(sent(0x202)->data, 16, 16);
            spools[with][k][1] = get_signed(sent(0x202)->data, 32, 16);
        }
        if (!with) {
            alone = ecu;
        }
    }
    TEST_ASSERT_EQUAL_MEMORY(spools[0], spools[1], sizeof spools[0]);
    TEST_ASSERT_EQUAL_MEMORY(&alone.controller.estimator, &ecu.controller.estimator,
                             sizeof alone.controller.estimator);
}

static void test_client_waits_for_a_plant_that_is_not_there(void)
{
    /* GIVEN a tick that waits for its sensors with the valves shut WHEN requests come one after the other THEN each is
     * answered at once */
    ecu_tick_begin(&ecu, &the_port);
    for (int k = 0; k < 5; k++) {
        wire.sent_count = 0;
        queue((struct can_frame_11bit){.id = SDO_REQUEST_ID, .length = 8, .data = {0x40, 0x14, 0x10}});
        TEST_ASSERT_FALSE(ecu_tick_receive(&ecu, &the_port));
        TEST_ASSERT_EQUAL_UINT(1, wire.sent_count);
        TEST_ASSERT_EQUAL_HEX32(SDO_ANSWER_ID, wire.sent[0].id);
    }
}

static void test_image_read_is_not_the_one_in_force(void)
{
    /* GIVEN an ECU WHEN its image is read, changed, written and read again THEN each is what is in force */
    TEST_ASSERT_EQUAL_HEX32(0, read_object(0x2000, 0));
    TEST_ASSERT_EQUAL_UINT32(PARAMETER_IMAGE_BYTES, got.length);
    TEST_ASSERT_EQUAL_MEMORY(&default_parameter_image, got.bytes, PARAMETER_IMAGE_BYTES);
    const struct parameter_image image = other_image();
    TEST_ASSERT_EQUAL_HEX32(0, write_segments(0x2000, 0, image.bytes, sizeof image.bytes, 99));
    expect_set(&image);
    TEST_ASSERT_EQUAL_HEX32(0, read_object(0x2000, 0));
    TEST_ASSERT_EQUAL_MEMORY(&image, got.bytes, PARAMETER_IMAGE_BYTES);
    TEST_ASSERT_DOUBLE_WITHIN(1e-6, 0.9, real32((uint16_t)(0x2100 + entry_named("wrist.q_max_rad"))));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_unknown_command_answered_or_ignored);
    RUN_TEST(test_segment_of_no_transfer_answered);
    RUN_TEST(test_repeated_segment_taken_twice);
    RUN_TEST(test_download_cut_anywhere_leaves_a_mixture);
    RUN_TEST(test_image_that_is_wrong_taken);
    RUN_TEST(test_valves_driven_while_there_is_no_machine);
    RUN_TEST(test_download_begun_while_the_valves_are_driven);
    RUN_TEST(test_length_of_a_write_not_looked_at);
    RUN_TEST(test_more_segments_than_an_image_written_past_it);
    RUN_TEST(test_image_longer_than_its_room_written_past_it);
    RUN_TEST(test_image_without_its_end_put_into_use);
    RUN_TEST(test_transfer_that_lost_its_object_sends_other_bytes);
    RUN_TEST(test_number_in_segments_not_understood);
    RUN_TEST(test_transfer_waits_for_ever);
    RUN_TEST(test_abort_of_the_client_answered);
    RUN_TEST(test_stopped_node_answers);
    RUN_TEST(test_frame_of_wrong_length_answered);
    RUN_TEST(test_answer_lost_on_a_busy_bus);
    RUN_TEST(test_valve_frame_waits_for_sdo);
    RUN_TEST(test_client_waits_for_a_plant_that_is_not_there);
    RUN_TEST(test_image_read_is_not_the_one_in_force);
    return UNITY_END();
}
