/* The text of the socketcand protocol (ports/linux/socketcand_text): what a TCP stream does to messages, and
 * what servers of different makes write. Each test is named after the failure it prevents. */
#include <string.h>

#include "ports/linux/socketcand_text.h"
#include "unity.h"

enum { MESSAGES_MAX = 16 };

static struct socketcand_parser parser;
static struct socketcand_message messages[MESSAGES_MAX];
static size_t message_count;

void setUp(void)
{
    memset(&parser, 0, sizeof parser);
    message_count = 0;
}

void tearDown(void)
{
}

static void feed_bytes(const char *bytes, size_t count)
{
    struct socketcand_message message;
    size_t consumed = 0;
    for (;;) {
        consumed += socketcand_parse(&parser, bytes + consumed, count - consumed, &message);
        if (message.kind == SOCKETCAND_NOTHING) {
            break;
        }
        TEST_ASSERT_LESS_THAN_size_t(MESSAGES_MAX, message_count);
        messages[message_count++] = message;
    }
    TEST_ASSERT_EQUAL_size_t(count, consumed);
}

static void feed(const char *text)
{
    feed_bytes(text, strlen(text));
}

static void expect_only(enum socketcand_kind kind, const char *text)
{
    setUp();
    feed(text);
    TEST_ASSERT_EQUAL_size_t_MESSAGE(1, message_count, text);
    TEST_ASSERT_EQUAL_INT_MESSAGE(kind, messages[0].kind, text);
}

static void expect_frame(size_t index, uint32_t id, const char *data, uint8_t length)
{
    uint8_t padded[8] = {0};
    memcpy(padded, data, length);
    TEST_ASSERT_LESS_THAN_size_t(message_count, index);
    TEST_ASSERT_EQUAL_INT(SOCKETCAND_FRAME, messages[index].kind);
    TEST_ASSERT_EQUAL_HEX32(id, messages[index].frame.id);
    TEST_ASSERT_EQUAL_UINT8(length, messages[index].frame.length);
    TEST_ASSERT_EQUAL_HEX8_ARRAY(padded, messages[index].frame.data, 8);
}

static void test_handshake_not_recognised(void)
{
    /* GIVEN the two answers of a handshake WHEN they come THEN each is its own kind */
    feed("< hi >< ok >");
    TEST_ASSERT_EQUAL_size_t(2, message_count);
    TEST_ASSERT_EQUAL_INT(SOCKETCAND_HI, messages[0].kind);
    TEST_ASSERT_EQUAL_INT(SOCKETCAND_OK, messages[1].kind);
}

static void test_frame_misread(void)
{
    /* GIVEN a frame as servers write it WHEN parsed THEN id, length and bytes are those of the text */
    feed("< frame 123 1700000000.123456 0102 >");
    TEST_ASSERT_EQUAL_size_t(1, message_count);
    expect_frame(0, 0x123, "\x01\x02", 2);
}

static void test_frame_of_eight_bytes_cut(void)
{
    /* GIVEN the longest frame and the highest id, hex in both cases WHEN parsed THEN all bytes are there */
    feed("< frame 7FF 1700000000.123456 DEADBEEFdeadbeef >");
    expect_frame(0, 0x7FF, "\xDE\xAD\xBE\xEF\xDE\xAD\xBE\xEF", 8);
}

static void test_empty_frame_refused(void)
{
    /* GIVEN frames without data, two blanks or one before > WHEN parsed THEN both have length 0 */
    feed("< frame 080 1700000000.123456  >< frame 080 1700000000.123456 >");
    TEST_ASSERT_EQUAL_size_t(2, message_count);
    expect_frame(0, 0x080, "", 0);
    expect_frame(1, 0x080, "", 0);
}

static void test_spaced_data_loses_bytes(void)
{
    /* GIVEN data with blanks between the bytes WHEN parsed THEN no byte is lost */
    feed("< frame 182 1.0 01 02 03 04 05 06 07 08 >");
    expect_frame(0, 0x182, "\x01\x02\x03\x04\x05\x06\x07\x08", 8);
}

static void test_short_id_refused(void)
{
    /* GIVEN an id without leading zeros WHEN parsed THEN it is 11 bit all the same */
    feed("< frame 80 1.0 05 >");
    expect_frame(0, 0x80, "\x05", 1);
}

static void test_bytes_of_the_last_frame_leak_into_the_next(void)
{
    /* GIVEN a long frame, then a short one WHEN parsed THEN the bytes past the short one's length are zero */
    feed("< frame 182 1.0 FFFFFFFFFFFFFFFF >< frame 282 1.0 01 >");
    expect_frame(1, 0x282, "\x01", 1);
}

static void test_extended_frame_taken_for_11_bit(void)
{
    /* GIVEN eight id digits, even when their value is small WHEN parsed THEN the frame is not ours */
    expect_only(SOCKETCAND_IGNORED, "< frame 00000182 1.0 0102 >");
    expect_only(SOCKETCAND_IGNORED, "< frame 18FF50E5 1.0 0102 >");
}

static void test_split_anywhere_loses_a_message(void)
{
    /* GIVEN a stream of messages WHEN TCP splits it at any place THEN the messages are the same */
    static const char stream[] = "< hi >< ok >< frame 182 1.5 0102 >\n< frame 080 1.5  >< error no bus >";
    const size_t length = sizeof stream - 1;
    for (size_t split = 0; split <= length; split++) {
        setUp();
        feed_bytes(stream, split);
        feed_bytes(stream + split, length - split);
        TEST_ASSERT_EQUAL_size_t(5, message_count);
        TEST_ASSERT_EQUAL_INT(SOCKETCAND_HI, messages[0].kind);
        TEST_ASSERT_EQUAL_INT(SOCKETCAND_OK, messages[1].kind);
        expect_frame(2, 0x182, "\x01\x02", 2);
        expect_frame(3, 0x080, "", 0);
        TEST_ASSERT_EQUAL_INT(SOCKETCAND_ERROR, messages[4].kind);
        TEST_ASSERT_EQUAL_STRING("no bus", messages[4].text);
    }
}

static void test_byte_by_byte_loses_a_message(void)
{
    /* GIVEN a stream of messages WHEN it comes one byte at a time THEN nothing is lost */
    static const char stream[] = "< frame 182 1.5 0102 >< frame 282 1.5 03 >";
    for (size_t i = 0; i < sizeof stream - 1; i++) {
        feed_bytes(stream + i, 1);
    }
    TEST_ASSERT_EQUAL_size_t(2, message_count);
    expect_frame(0, 0x182, "\x01\x02", 2);
    expect_frame(1, 0x282, "\x03", 1);
}

static void test_error_reply_without_its_words(void)
{
    /* GIVEN a server's complaint WHEN parsed THEN its words are there for the user, without blanks around */
    expect_only(SOCKETCAND_ERROR, "< error could not open bus  >");
    TEST_ASSERT_EQUAL_STRING("could not open bus", messages[0].text);
    expect_only(SOCKETCAND_ERROR, "< error >");
    TEST_ASSERT_EQUAL_STRING("", messages[0].text);
    /* and as our hub writes it, with the start of an error frame for clients that expect one */
    expect_only(SOCKETCAND_ERROR, "< error 000 1700000000.123456 open a bus first >");
    TEST_ASSERT_EQUAL_STRING("open a bus first", messages[0].text);
}

static void test_error_frame_of_the_bus_ends_the_run(void)
{
    /* GIVEN a CAN error frame, which servers report with the same word WHEN parsed THEN it is no complaint */
    expect_only(SOCKETCAND_IGNORED, "< error 004 1700000000.123456 >");
}

static void test_other_well_formed_text_counted_as_broken(void)
{
    /* GIVEN answers and frames that are not for us WHEN parsed THEN they are ignored, not counted */
    expect_only(SOCKETCAND_IGNORED, "< echo >");
    expect_only(SOCKETCAND_IGNORED, "< fdframe 123 1 1700000000.123456 00112233445566778899 >");
}

static void test_malformed_frame_becomes_a_command(void)
{
    /* GIVEN texts that are nearly frames WHEN parsed THEN each is refused and counted once */
    static const char *const texts[] = {
        "< frame >",
        "< frame 123 >",
        "< frame 800 1.0 01 >",                 /* above 11 bit in three digits */
        "< frame 0123 1.0 01 >",                /* neither three digits nor eight */
        "< frame 123456789 1.0 01 >",           /* more than 32 bit */
        "< frame -12 1.0 01 >",                 /* a sign */
        "< frame 0x1 1.0 01 >",                 /* a prefix */
        "< frame 1G3 1.0 01 >",                 /* no hex digit */
        "< frame 123 0102 010203 04 0506Z7 >",  /* no hex digit in the data */
        "< frame 123 . 01 >",                   /* no time */
        "< frame 123 1.0.0 01 >",               /* no time */
        "< frame 123 1e9 01 >",                 /* no time */
        "< frame 123 -1.0 01 >",                /* no time */
        "< frame 123 1.0 1 >",                  /* half a byte */
        "< frame 123 1.0 010 >",                /* one and a half */
        "< frame 123 1.0 010203040506070809 >", /* nine bytes */
        "< frame 123 1.0 0102030405060708 09 >",
        "< frames 123 1.0 01 >",
        "< FRAME 123 1.0 01 >",
        "< hi there >",
        "< okay >",
        "<>",
        "<   >",
    };
    for (size_t i = 0; i < sizeof texts / sizeof texts[0]; i++) {
        expect_only(SOCKETCAND_MALFORMED, texts[i]);
    }
}

static void test_garbage_swallows_the_next_frame(void)
{
    /* GIVEN another protocol's bytes, control characters or a message cut short WHEN a frame follows
     * THEN the garbage counts once and the frame is taken */
    static const char *const garbage[] = {"HTTP/1.1 400 Bad Request",
                                          ">",
                                          "> > >",
                                          "< frame 1\x01 2 >",
                                          "< frame 123 1.0 01",
                                          "< fra\xFFme >",
                                          "< hi > x"};
    for (size_t i = 0; i < sizeof garbage / sizeof garbage[0]; i++) {
        setUp();
        feed(garbage[i]);
        feed("< frame 182 1.0 0102 >");
        size_t malformed = 0;
        for (size_t m = 0; m < message_count; m++) {
            malformed += messages[m].kind == SOCKETCAND_MALFORMED;
        }
        TEST_ASSERT_EQUAL_size_t_MESSAGE(1, malformed, garbage[i]);
        expect_frame(message_count - 1, 0x182, "\x01\x02", 2);
    }
}

static void test_zero_byte_ends_the_text_early(void)
{
    /* GIVEN a zero byte inside a message WHEN parsed THEN the message is refused, not read up to the zero */
    static const char stream[] = "< frame 182 1.0 0102\0 >< ok >";
    feed_bytes(stream, sizeof stream - 1);
    TEST_ASSERT_EQUAL_size_t(2, message_count);
    TEST_ASSERT_EQUAL_INT(SOCKETCAND_MALFORMED, messages[0].kind);
    TEST_ASSERT_EQUAL_INT(SOCKETCAND_OK, messages[1].kind);
}

static void test_endless_text_overruns_the_buffer(void)
{
    /* GIVEN a text that never ends WHEN 100,000 bytes of it come THEN one message is refused, and the parser
     * recovers at the next < */
    feed("< frame ");
    for (size_t i = 0; i < 10000; i++) {
        feed("0123456789");
    }
    TEST_ASSERT_EQUAL_size_t(1, message_count);
    TEST_ASSERT_EQUAL_INT(SOCKETCAND_MALFORMED, messages[0].kind);
    feed(" >< hi >");
    TEST_ASSERT_EQUAL_size_t(2, message_count);
    TEST_ASSERT_EQUAL_INT(SOCKETCAND_HI, messages[1].kind);
}

static void test_longest_text_refused_or_overrun_by_one(void)
{
    /* GIVEN complaints of exactly the longest length and of one more WHEN parsed THEN the first is whole and
     * the second refused */
    for (size_t extra = 0; extra <= 1; extra++) {
        char text[SOCKETCAND_TEXT_BYTES + 4];
        memset(text, 'x', sizeof text);
        memcpy(text, "<error ", 7);
        text[1 + SOCKETCAND_TEXT_BYTES + extra] = '>';
        text[2 + SOCKETCAND_TEXT_BYTES + extra] = '\0';
        expect_only(extra == 0 ? SOCKETCAND_ERROR : SOCKETCAND_MALFORMED, text);
        TEST_ASSERT_EQUAL_size_t(extra == 0 ? SOCKETCAND_TEXT_BYTES - 6 : 0, strlen(messages[0].text));
    }
}

static void test_line_ends_between_messages_counted_as_garbage(void)
{
    /* GIVEN blanks and line ends between messages WHEN parsed THEN nothing is counted */
    feed("< ok >\r\n  < ok >\n");
    TEST_ASSERT_EQUAL_size_t(2, message_count);
    TEST_ASSERT_EQUAL_INT(SOCKETCAND_OK, messages[1].kind);
}

static void test_sent_frame_unreadable_for_servers(void)
{
    /* GIVEN frames WHEN formatted THEN the text is what a socketcand server reads, the id always in three
     * digits */
    static const struct {
        struct can_frame_11bit frame;
        const char *text;
    } cases[] = {
        {{.id = 0x123, .length = 2, .data = {1, 2}}, "< send 123 2 1 2 >"},
        {{.id = 0x080, .length = 1, .data = {240}}, "< send 080 1 F0 >"},
        {{.id = 0x000, .length = 0}, "< send 000 0 >"},
        {{.id = 0x7FF, .length = 8, .data = {255, 0, 16, 15, 1, 128, 127, 255}},
         "< send 7FF 8 FF 0 10 F 1 80 7F FF >"},
    };
    char text[SOCKETCAND_SEND_BYTES];
    for (size_t i = 0; i < sizeof cases / sizeof cases[0]; i++) {
        const size_t length = socketcand_format_send(&cases[i].frame, text, sizeof text);
        TEST_ASSERT_EQUAL_STRING(cases[i].text, text);
        TEST_ASSERT_EQUAL_size_t(strlen(cases[i].text), length);
    }
}

static void test_longest_send_overruns_the_buffer(void)
{
    /* GIVEN the longest send command WHEN formatted THEN it and its zero fit in SOCKETCAND_SEND_BYTES */
    struct can_frame_11bit frame = {.id = 0x7FF, .length = 8};
    memset(frame.data, 0xFF, sizeof frame.data);
    char text[SOCKETCAND_SEND_BYTES + 1];
    text[SOCKETCAND_SEND_BYTES] = '#';
    TEST_ASSERT_LESS_THAN_size_t(SOCKETCAND_SEND_BYTES,
                                 socketcand_format_send(&frame, text, sizeof text - 1));
    TEST_ASSERT_EQUAL_CHAR('#', text[SOCKETCAND_SEND_BYTES]);
}

static void test_impossible_frame_sent(void)
{
    /* GIVEN what is no 11 bit frame, or a buffer too small WHEN formatted THEN nothing is written */
    char text[SOCKETCAND_SEND_BYTES] = "untouched";
    const struct can_frame_11bit extended = {.id = 0x800};
    const struct can_frame_11bit overlong = {.id = 0x123, .length = 9};
    const struct can_frame_11bit good = {.id = 0x123, .length = 1};
    TEST_ASSERT_EQUAL_size_t(0, socketcand_format_send(&extended, text, sizeof text));
    TEST_ASSERT_EQUAL_size_t(0, socketcand_format_send(&overlong, text, sizeof text));
    TEST_ASSERT_EQUAL_size_t(0, socketcand_format_send(&good, text, sizeof text - 1));
    TEST_ASSERT_EQUAL_STRING("untouched", text);
}

static void test_channel_name_cut(void)
{
    /* GIVEN a channel name WHEN it fits exactly THEN it is whole; one byte less of room and it is refused */
    char text[sizeof "< open vcan0 >"];
    TEST_ASSERT_EQUAL_size_t(14, socketcand_format_open("vcan0", text, sizeof text));
    TEST_ASSERT_EQUAL_STRING("< open vcan0 >", text);
    TEST_ASSERT_EQUAL_size_t(0, socketcand_format_open("vcan0", text, sizeof text - 1));
}

int main(void)
{
    UNITY_BEGIN();
    RUN_TEST(test_handshake_not_recognised);
    RUN_TEST(test_frame_misread);
    RUN_TEST(test_frame_of_eight_bytes_cut);
    RUN_TEST(test_empty_frame_refused);
    RUN_TEST(test_spaced_data_loses_bytes);
    RUN_TEST(test_short_id_refused);
    RUN_TEST(test_bytes_of_the_last_frame_leak_into_the_next);
    RUN_TEST(test_extended_frame_taken_for_11_bit);
    RUN_TEST(test_split_anywhere_loses_a_message);
    RUN_TEST(test_byte_by_byte_loses_a_message);
    RUN_TEST(test_error_reply_without_its_words);
    RUN_TEST(test_error_frame_of_the_bus_ends_the_run);
    RUN_TEST(test_other_well_formed_text_counted_as_broken);
    RUN_TEST(test_malformed_frame_becomes_a_command);
    RUN_TEST(test_garbage_swallows_the_next_frame);
    RUN_TEST(test_zero_byte_ends_the_text_early);
    RUN_TEST(test_endless_text_overruns_the_buffer);
    RUN_TEST(test_longest_text_refused_or_overrun_by_one);
    RUN_TEST(test_line_ends_between_messages_counted_as_garbage);
    RUN_TEST(test_sent_frame_unreadable_for_servers);
    RUN_TEST(test_longest_send_overruns_the_buffer);
    RUN_TEST(test_impossible_frame_sent);
    RUN_TEST(test_channel_name_cut);
    return UNITY_END();
}
