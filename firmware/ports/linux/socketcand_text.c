#include "ports/linux/socketcand_text.h"

#include <stdint.h>
#include <stdio.h>
#include <string.h>

enum { ID_MAX = 0x7FF, EXTENDED_ID_DIGITS = 8, STANDARD_ID_DIGITS_MAX = 3, DATA_BYTES_MAX = 8 };

struct token {
    const char *start;
    size_t length;
};

/* The next run of characters that are not blanks; length 0 at the end of the text. */
static struct token next_token(const char **cursor)
{
    const char *start = *cursor + strspn(*cursor, " ");
    const size_t length = strcspn(start, " ");
    *cursor = start + length;
    return (struct token){start, length};
}

static bool token_is(struct token token, const char *word)
{
    return token.length == strlen(word) && memcmp(token.start, word, token.length) == 0;
}

/* Not strtoul and isxdigit: those take signs, blanks, 0x and the locale's idea of a digit. */
static bool hex_digit(char character, uint32_t *value)
{
    if (character >= '0' && character <= '9') {
        *value = (uint32_t)(character - '0');
    } else if (character >= 'a' && character <= 'f') {
        *value = (uint32_t)(character - 'a') + 10U;
    } else if (character >= 'A' && character <= 'F') {
        *value = (uint32_t)(character - 'A') + 10U;
    } else {
        return false;
    }
    return true;
}

static bool parse_id(struct token token, uint32_t *id)
{
    if (token.length == 0 || token.length > EXTENDED_ID_DIGITS) {
        return false;
    }
    *id = 0;
    for (size_t i = 0; i < token.length; i++) {
        uint32_t digit;
        if (!hex_digit(token.start[i], &digit)) {
            return false;
        }
        *id = *id << 4 | digit;
    }
    return true;
}

/* Seconds with an optional fraction. The value is the server's business: nothing here reads it. */
static bool is_timestamp(struct token token)
{
    size_t digits = 0;
    size_t points = 0;
    for (size_t i = 0; i < token.length; i++) {
        if (token.start[i] >= '0' && token.start[i] <= '9') {
            digits++;
        } else if (token.start[i] == '.') {
            points++;
        } else {
            return false;
        }
    }
    return digits > 0 && points <= 1;
}

/* Pairs of hex digits up to the end, in one run ("0102") or several ("01 02"). */
static bool parse_data(const char *cursor, struct can_frame_11bit *frame)
{
    for (struct token token = next_token(&cursor); token.length > 0; token = next_token(&cursor)) {
        if (token.length % 2 != 0 || token.length / 2 > (size_t)(DATA_BYTES_MAX - frame->length)) {
            return false;
        }
        for (size_t i = 0; i < token.length; i += 2) {
            uint32_t high;
            uint32_t low;
            if (!hex_digit(token.start[i], &high) || !hex_digit(token.start[i + 1], &low)) {
                return false;
            }
            frame->data[frame->length++] = (uint8_t)(high << 4 | low);
        }
    }
    return true;
}

static enum socketcand_kind parse_frame(const char *cursor, struct can_frame_11bit *frame)
{
    const struct token id = next_token(&cursor);
    if (!parse_id(id, &frame->id) || !is_timestamp(next_token(&cursor)) || !parse_data(cursor, frame)) {
        return SOCKETCAND_MALFORMED;
    }
    if (id.length == EXTENDED_ID_DIGITS) {
        return SOCKETCAND_IGNORED;
    }
    return id.length <= STANDARD_ID_DIGITS_MAX && frame->id <= ID_MAX ? SOCKETCAND_FRAME
                                                                      : SOCKETCAND_MALFORMED;
}

/* The words of the server's complaint. "error 004 1700000000.123456" alone reports an error frame on the bus,
 * and some servers put such a start before their words, for the sake of clients that expect it. */
static enum socketcand_kind parse_error(const char *cursor, char *words)
{
    const char *rest = cursor;
    uint32_t id;
    if (parse_id(next_token(&rest), &id) && is_timestamp(next_token(&rest))) {
        cursor = rest;
    }
    const bool has_start = cursor == rest;
    cursor += strspn(cursor, " ");
    size_t length = strlen(cursor);
    if (has_start && length == 0) {
        return SOCKETCAND_IGNORED;
    }
    while (length > 0 && cursor[length - 1] == ' ') {
        length--;
    }
    memcpy(words, cursor, length);
    words[length] = '\0';
    return SOCKETCAND_ERROR;
}

/* `text` is what stood between < and >: printable, zero-terminated. */
static enum socketcand_kind parse_text(const char *text, struct socketcand_message *message)
{
    const char *cursor = text;
    const struct token word = next_token(&cursor);
    if (token_is(word, "frame")) {
        return parse_frame(cursor, &message->frame);
    }
    if (token_is(word, "error")) {
        return parse_error(cursor, message->text);
    }
    if (token_is(word, "fdframe")) {
        return SOCKETCAND_IGNORED;
    }
    if (next_token(&cursor).length > 0) {
        return SOCKETCAND_MALFORMED;
    }
    if (token_is(word, "hi")) {
        return SOCKETCAND_HI;
    }
    if (token_is(word, "ok")) {
        return SOCKETCAND_OK;
    }
    return token_is(word, "echo") ? SOCKETCAND_IGNORED : SOCKETCAND_MALFORMED;
}

/* Takes one byte; gives the message that it ends, if it ends one. */
static enum socketcand_kind take_byte(struct socketcand_parser *parser, char byte,
                                      struct socketcand_message *message)
{
    if (byte == '<') {
        const bool cut_short = parser->place == SOCKETCAND_INSIDE;
        parser->place = SOCKETCAND_INSIDE;
        parser->text_bytes = 0;
        return cut_short ? SOCKETCAND_MALFORMED : SOCKETCAND_NOTHING;
    }
    if (parser->place == SOCKETCAND_SKIPPING) {
        return SOCKETCAND_NOTHING;
    }
    if (parser->place == SOCKETCAND_OUTSIDE) {
        if (byte == ' ' || byte == '\r' || byte == '\n') {
            return SOCKETCAND_NOTHING;
        }
        parser->place = SOCKETCAND_SKIPPING;
        return SOCKETCAND_MALFORMED;
    }
    if (byte == '>') {
        parser->place = SOCKETCAND_OUTSIDE;
        parser->text[parser->text_bytes] = '\0';
        return parse_text(parser->text, message);
    }
    if (byte < ' ' || byte > '~' || parser->text_bytes == SOCKETCAND_TEXT_BYTES) {
        parser->place = SOCKETCAND_SKIPPING;
        return SOCKETCAND_MALFORMED;
    }
    parser->text[parser->text_bytes++] = byte;
    return SOCKETCAND_NOTHING;
}

size_t socketcand_parse(struct socketcand_parser *parser, const char *bytes, size_t bytes_count,
                        struct socketcand_message *message)
{
    message->kind = SOCKETCAND_NOTHING;
    message->frame = (struct can_frame_11bit){0};
    message->text[0] = '\0';
    size_t consumed = 0;
    while (consumed < bytes_count && message->kind == SOCKETCAND_NOTHING) {
        message->kind = take_byte(parser, bytes[consumed], message);
        consumed++;
    }
    return consumed;
}

size_t socketcand_format_send(const struct can_frame_11bit *frame, char *text, size_t size_bytes)
{
    static const char digits[] = "0123456789ABCDEF";
    if (frame->id > ID_MAX || frame->length > DATA_BYTES_MAX || size_bytes < SOCKETCAND_SEND_BYTES) {
        return 0;
    }
    /* By hand: this runs several times per tick, and printf is most of the cost of a tick otherwise. */
    static const char start[] = "< send ";
    memcpy(text, start, sizeof start);
    size_t used = sizeof start - 1;
    text[used++] = digits[frame->id >> 8 & 0xF];
    text[used++] = digits[frame->id >> 4 & 0xF];
    text[used++] = digits[frame->id & 0xF];
    text[used++] = ' ';
    text[used++] = digits[frame->length];
    for (uint8_t i = 0; i < frame->length; i++) {
        text[used++] = ' ';
        if (frame->data[i] > 0xF) {
            text[used++] = digits[frame->data[i] >> 4];
        }
        text[used++] = digits[frame->data[i] & 0xF];
    }
    text[used++] = ' ';
    text[used++] = '>';
    text[used] = '\0';
    return used;
}

size_t socketcand_format_open(const char *channel, char *text, size_t size_bytes)
{
    const int length = snprintf(text, size_bytes, "< open %s >", channel);
    return length < 0 || (size_t)length >= size_bytes ? 0 : (size_t)length;
}
